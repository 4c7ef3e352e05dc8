# The Tcl package genomix: a client of ROS components (rosAFE, bass) through the HTTP server genomixd.
#
#   package require genomix
#   set g [genomix::connect]                  ;# or genomix::connect host:port, or genomix::localhost
#   $g load rosAFE
#   rosAFE::GammatoneProc {name left fb_nChannels 32}
#   puts [rosAFE::getParameters]
#   puts [rosAFE::request ild {fb_nChannels 16}]      ;# with all processors that it needs; docs/request.md
#   set request [rosAFE::getSignals &]; $request wait; puts [$request result]
#   rosAFE::modifyParameter ... & callback    ;# without a callback, unread errors are reported to bgerror
#   rosAFE::GammatoneProc -h                  ;# prints parameters, types, defaults and ranges
#
# Errors: the message is a dict `ex ::rosAFE::e_noSuchProcessor ?detail {...}? ?what {...}?`, with the reason in `what`,
# unless the detail contains it. The error code is {GENOM ex detail}.
# Data from the server is never evaluated.

package require Tcl 8.6

namespace eval ::genomix {
    namespace export connect localhost

    variable root [file dirname [file normalize [info script]]]
    variable clients 0 ;# number of handles so far: genomix1, genomix2, ...
    variable requests 0 ;# number of background requests so far: ::genomix::request1, ...
    variable reportDelay 500 ;# ms in which a script can read the status of a failed request; then its error is reported
    variable failed {} ;# background requests with unreported errors, as keys
    variable private {} ;# the server started by localhost: {channel port}
}

# genomix::connect ?host?:port??
#
# Connect to a genomixd and return a handle: a command with the methods load, unload, rpath and destroy. The default
# address is that of the environment variable GENOMIXD, or localhost:8080.
proc ::genomix::connect {{address ""}} {
    variable clients
    if {$address eq "" && [info exists ::env(GENOMIXD)]} {
        set address $::env(GENOMIXD)
    }
    if {![regexp {^(\[[^]]+\]|[^:]*)(:(\d+))?$} $address -> host - port]} {
        ::genomix::Refuse "address: expected host, host:port or :port, got \"$address\""
    }
    set host [string trim $host {[]}]
    set client [::genomix::Client create ::genomix[incr clients] \
        [expr {$host in {"" localhost} ? "127.0.0.1" : $host}] [expr {$port eq "" ? 8080 : $port}]]
    return [namespace tail $client]
}

# genomix::localhost
#
# As connect, with a private server on a free port that ends with this process.
proc ::genomix::localhost {} {
    variable private
    if {$private eq {} || [eof [lindex $private 0]]} {
        set private [::genomix::StartServer]
    }
    return [::genomix::connect 127.0.0.1:[lindex $private 1]]
}

proc ::genomix::StartServer {} {
    variable root
    # In a checkout next to the package, in bin/ of a catkin installation, or on PATH.
    set program [lindex [auto_execok genomixd] 0]
    foreach place {../../scripts ../../../bin} {
        set candidate [file normalize [file join $root $place genomixd]]
        if {[file executable $candidate]} {
            set program $candidate
            break
        }
    }
    if {$program eq ""} {
        ::genomix::Refuse "genomixd is not on PATH" ::genom::mwerr
    }
    set channel [open [list | $program -p 0 --until-eof 2>@stderr] r+]
    if {[gets $channel port] < 0 || ![string is digit -strict $port]} {
        catch {close $channel}
        ::genomix::Refuse "cannot start $program" ::genom::mwerr
    }
    # Non-blocking, so that this process does not wait for the end of the server.
    fconfigure $channel -blocking 0
    return [list $channel $port]
}

# Raise the error of a component or of the server; body is a dict ex ... ?detail {...}? ?what {...}?.
proc ::genomix::Raise {body} {
    set detail {}
    if {[dict exists $body detail]} {
        set detail [dict get $body detail]
    }
    return -code error -level 2 -errorcode [list GENOM [dict get $body ex] $detail] $body
}

# Return a text as one line, for a terminal.
proc ::genomix::OneLine {text} {
    return [regsub -all {[[:cntrl:]]+} $text { }]
}

# Raise an error for a request that has not been sent.
proc ::genomix::Refuse {what {ex ::genom::serialization}} {
    set detail [dict create what $what]
    return -code error -level 2 -errorcode [list GENOM $ex $detail] [dict create ex $ex detail $detail]
}

apply {{} {
    variable root
    foreach part {http client request command arguments help terminal} {
        uplevel #0 [list source -encoding utf-8 [file join $root $part.tcl]]
    }
} ::genomix}

package provide genomix 1.8
