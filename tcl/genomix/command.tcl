# The commands of a component: one for each service and port, with switches, background requests and help.

# Create the commands of a component in the namespace ::name.
proc ::genomix::Offer {client name description} {
    foreach {kind entries} [list Service [dict get $description services] Port [dict get $description ports]] {
        dict for {entry about} $entries {
            foreach command [list $entry {*}[dict values [dict get $about aliases]]] {
                if {[regexp {^\w+$} $command]} {
                    namespace eval ::$name {}
                    interp alias {} ::${name}::$command {} ::genomix::$kind $client $name $entry
                }
            }
        }
    }
    # The user guide writes ":: rosAFE :: modifyParameter" with spaces.
    if {[info commands ::] eq ""} {
        interp alias {} :: {} ::genomix::Spaced
    }
}

# :: component :: service ?arg ...?
proc ::genomix::Spaced {{component ""} {colons ""} {service ""} args} {
    set command ::${component}::$service
    if {$colons ne "::" || [info commands $command] eq ""} {
        return -code error -errorcode {TCL LOOKUP COMMAND ::} "invalid command name \"::\""
    }
    tailcall $command {*}$args
}

# Call a service: component::service ?switch ...? ?--? ?argument ...? ?& ?callback ...??
proc ::genomix::Service {client name service args} {
    set about [dict get [$client description $name] services $service]
    lassign [::genomix::Words $args ${name}::$service] switches words background callback
    if {[dict get $switches help]} {
        return [::genomix::ServiceHelp $name $service $about]
    }
    set parameters [dict get $about parameters]
    if {[::genomix::AsksForArguments $args $words $parameters]} {
        set words [list [::genomix::Ask $about]]
    }
    set query [dict create input [::genomix::Input $service $about $words]]
    tailcall ::genomix::Perform $client [list $name $service] $query $switches $background $callback
}

# Read a port: component::port ?switch ...? ?--? ?element? ?& ?callback ...??
proc ::genomix::Port {client name port args} {
    set about [dict get [$client description $name] ports $port]
    lassign [::genomix::Words $args ${name}::$port] switches words background callback
    if {[dict get $switches help]} {
        return [::genomix::PortHelp $name $port $about]
    }
    if {[llength $words] > 1} {
        ::genomix::Refuse "${name}::$port: expected at most one element, got [llength $words] arguments"
    }
    set query [dict create element [lindex $words 0]]
    tailcall ::genomix::Perform $client [list $name $port] $query $switches $background $callback
}

# Send a request; wait for its result or return it, depending on the switches.
proc ::genomix::Perform {client words query switches background callback} {
    if {$::tcl_interactive} {
        $client poll ;# tclsh does not process events at its prompt
        foreach request [dict keys $::genomix::failed] {
            catch {$request overdue}
        }
    }
    if {[dict get $switches oneway]} {
        $client get [list send {*}$words] [dict merge $query {oneway 1}]
        return
    }
    if {$background || [dict get $switches send] || [dict get $switches ack]} {
        if {[dict get $switches ack]} {
            dict set query ack 1
        }
        return [$client send [list send {*}$words] $query $callback]
    }
    return [$client get [list call {*}$words] $query]
}

# Parse the words of a command; return {switches arguments background callback}.
proc ::genomix::Words {arguments command} {
    set switches {help 0 send 0 ack 0 oneway 0}
    while {[string match -?* [lindex $arguments 0]] && ![string is double -strict [lindex $arguments 0]]} {
        set arguments [lassign $arguments word]
        if {$word eq "--"} {
            break
        }
        set matching [lsearch -all -inline -glob [dict keys $switches] [string range $word 1 end]*]
        if {[llength $matching] != 1} {
            ::genomix::Refuse "$command: expected a switch (-help, -send, -ack, -oneway, --), got \"$word\""
        }
        dict set switches [lindex $matching 0] 1
    }
    set at [lsearch -exact $arguments &]
    if {$at < 0} {
        return [list $switches $arguments 0 {}]
    }
    return [list $switches [lrange $arguments 0 $at-1] 1 [lrange $arguments $at+1 end]]
}
