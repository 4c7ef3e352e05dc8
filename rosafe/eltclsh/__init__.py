"""eltclsh and elwish: Tcl shells with line editing, on Python's tkinter and readline. No ROS here: that is for Tcl."""
