"""eltclsh and elwish: Tcl shells with line editing, based on tkinter and readline. ROS is accessed from Tcl only."""
