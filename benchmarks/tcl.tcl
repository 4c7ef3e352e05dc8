# Speed of the Tcl package: round trips of a synchronous call, of reading a port and of a background request, and the
# throughput of a large result. Needs roscore, rosAFE-ros and bass-ros; starts its own genomixd.
#
#   . scripts/env.sh; roscore & bass-ros & rosAFE-ros & tclsh benchmarks/tcl.tcl

package require genomix

# Print the median and the 99th percentile of the duration of a script in milliseconds.
proc measure {label count script} {
    uplevel #0 $script ;# the first call opens connections
    set times {}
    for {set i 0} {$i < $count} {incr i} {
        set start [clock microseconds]
        uplevel #0 $script
        lappend times [expr {([clock microseconds] - $start) / 1000.0}]
    }
    set times [lsort -real $times]
    puts [format "%-32s median %7.2f ms   p99 %7.2f ms   (%d)" $label \
        [lindex $times [expr {$count / 2}]] [lindex $times [expr {$count * 99 / 100}]] $count]
}

set handle [genomix::localhost]
$handle load bass
$handle load rosAFE
rosAFE::connect_port Audio bass/Audio
bass::Acquire scene:
rosAFE::InputProc
rosAFE::PreProc
rosAFE::GammatoneProc
while {[dict get [rosAFE::preProcPort preProc] preProcPort lastFrameIndex] == 0} {
    after 20
}
measure "rosAFE::getDependencies" 1000 {rosAFE::getDependencies gammatone}
measure "rosAFE::getParameters" 300 {rosAFE::getParameters}
measure "rosAFE::getDependencies &, wait" 300 {
    set request [rosAFE::getDependencies gammatone &]
    $request wait
    $request clean
}
measure "rosAFE::preProcPort (2 x 44100)" 10 {rosAFE::preProcPort preProc}
bass::Stop
set start [clock microseconds]
set text [rosAFE::gammatonePort gammatone]
set seconds [expr {([clock microseconds] - $start) / 1e6}]
puts [format "%-32s %.1f MB in %.2f s: %.0f MB/s" "rosAFE::gammatonePort (2 x 31)" \
    [expr {[string length $text] / 1e6}] $seconds [expr {[string length $text] / 1e6 / $seconds}]]
set start [clock microseconds]
set value [dict get $text gammatonePort left dataN 30 data 44099]
puts [format "%-32s %.2f s" "first access to a number in it" [expr {([clock microseconds] - $start) / 1e6}]]
rosAFE::Stop
