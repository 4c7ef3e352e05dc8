# Index of the Tcl package genomix: clients of ROS components through genomixd.
if {![package vsatisfies [package provide Tcl] 8.6]} return
package ifneeded genomix 1.8 [list source [file join $dir genomix.tcl]]
