"""Tests of genomixd and of the Tcl package, with real masters, nodes, HTTP clients and tclsh."""
