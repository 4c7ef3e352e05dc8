# The handles genomix1, genomix2, ...: a connection to one genomixd, and the components loaded through it.

oo::class create ::genomix::Client {
    # Host Port: of the server.   Session: our name there.   Channel: the kept connection, or empty.
    # Components: what the server told about each loaded component, by the name of its namespace.
    # Events: the connection on which the server tells of requests, or empty.   Event: the one that is being read.
    # Requests: the requests that are not finished, by their ids.
    variable Host Port Session Channel Components Events Event Requests

    constructor {host port} {
        lassign [list $host $port] Host Port
        lassign {} Channel Events
        lassign {{} {} {}} Components Event Requests
        set Session tcl-[pid]-[namespace tail [self]]-[format %08x [expr {int(rand() * 0xffffffff)}]]
        my get {session start}
    }

    destructor {
        foreach name [dict keys $Components] {
            my Remove $name
        }
        catch {my get {session stop}}
        foreach channel [list $Channel $Events] {
            catch {close $channel}
        }
    }

    # load component ?-i instance? ?as name?
    #
    # Offer the services and ports of a component that runs as commands of the namespace ::name (by default that of
    # the instance, by default that of the component), and return that name.
    method load {component args} {
        set query {}
        foreach {option value} $args {
            switch -- $option {
                -i {dict set query i $value}
                as {dict set query as $value}
                default {
                    ::genomix::Refuse "load: unknown option \"$option\", there are: -i instance, as name"
                }
            }
        }
        if {[llength $args] % 2} {
            ::genomix::Refuse "load: [lindex $args end] needs a value"
        }
        set component [file rootname [file tail $component]]
        set description [my get [list load $component] $query]
        if {[catch {dict get $description name} name]
            || [catch {dict size [dict get $description services]}] || [catch {dict size [dict get $description ports]}]
        } {
            ::genomix::Refuse "genomixd at $Host:$Port describes no component" ::genom::mwerr
        }
        if {![regexp {^[A-Za-z]\w*$} $name] || $name in {genomix oo tcl zlib el}} {
            ::genomix::Refuse "load: \"$name\" cannot be the name of a component's namespace; use: as name"
        }
        if {[dict exists $Components $name]} {
            my Remove $name
        }
        dict set Components $name $description
        ::genomix::Offer [self] $name $description
        return $name
    }

    # unload name
    #
    # Remove the commands of a component; the component itself goes on.
    method unload {name} {
        if {![dict exists $Components $name]} {
            ::genomix::Refuse "unload: \"$name\" is not loaded; loaded are: [dict keys $Components]"
        }
        my Remove $name
        catch {my get [list unload $name]}
        return
    }

    method Remove {name} {
        dict unset Components $name
        if {[namespace exists ::$name]} {
            namespace delete ::$name
        }
    }

    # rpath dir
    #
    # Accepted for the original's scripts. Components are found on the ROS graph, so there is nowhere to look.
    method rpath {dir} {
        return
    }

    # --- for the other files of the package ---

    method description {name} {
        return [dict get $Components $name]
    }

    # GET /words...?query of our session, and return the answer. Errors are those of the component or of the server.
    method get {words {query {}}} {
        if {[lindex $words 0] in {call send}} {
            # Whatever the server has forgotten (it may be another one by now) it loads again.
            dict set query i [dict get $Components [lindex $words 1] instance]
        }
        dict set query s $Session
        dict set query syntax tcl
        set url [::genomix::http::url $words $query]
        if {$Channel ne "" && ![::genomix::http::alive $Channel]} {
            my Disconnect
        }
        if {$Channel eq ""} {
            set Channel [::genomix::http::open $Host $Port]
        }
        if {[catch {
            ::genomix::http::send $Channel $Host $Port $url
            lassign [::genomix::http::head $Channel] status headers
            set body [::genomix::http::body $Channel $headers [join [lrange $words 1 2] ::]]
        } problem]} {
            my Disconnect
            ::genomix::Refuse "genomixd at $Host:$Port: $problem" ::genom::mwerr
        }
        if {[dict exists $headers connection] && [dict get $headers connection] eq "close"} {
            my Disconnect
        }
        if {$status == 200} {
            return $body
        }
        if {[catch {dict get $body ex}]} {
            ::genomix::Refuse "genomixd at $Host:$Port answers $status: [string range $body 0 200]" ::genom::mwerr
        }
        ::genomix::Raise $body
    }

    method Disconnect {} {
        catch {close $Channel}
        set Channel ""
    }

    # --- requests in the background ---

    # Send a request that the server tells us the end of; the words and query are those of the URL.
    method send {words query callback} {
        my Listen
        set request [::genomix::Request create ::genomix::request[incr ::genomix::requests] [self] \
            [join [lrange $words 1 2] ::] $callback]
        try {
            set status [my get $words $query]
            if {[catch {list [dict get $status id] [dict get $status status]}]} {
                ::genomix::Refuse "genomixd at $Host:$Port does not say what has become of it" ::genom::mwerr
            }
        } on error {message options} {
            $request destroy
            return -options $options $message
        }
        dict set Requests [dict get $status id] $request
        $request update $status
        return $request
    }

    # Follow a request no more.
    method forget {id} {
        dict unset Requests $id
    }

    method Listen {} {
        if {$Events ne ""} {
            return
        }
        set Events [::genomix::http::open $Host $Port]
        # HTTP/1.0: the answer comes as it is and not in chunks.
        ::genomix::http::send $Events $Host $Port \
            [::genomix::http::url {session listen} [dict create s $Session syntax tcl]] 1.0
        if {[catch {::genomix::http::head $Events} head] || [lindex $head 0] != 200} {
            catch {close $Events}
            set Events ""
            ::genomix::Refuse "genomixd at $Host:$Port tells no events: $head" ::genom::mwerr
        }
        fconfigure $Events -blocking 0
        fileevent $Events readable [namespace code {my ReadEvents}]
    }

    # Take what events have come so far.
    method poll {} {
        if {$Events ne ""} {
            my ReadEvents
        }
    }

    method ReadEvents {} {
        while {$Events ne "" && ![catch {gets $Events line} length] && $length >= 0} {
            set line [encoding convertfrom utf-8 [string trimright $line \r]]
            if {$line eq ""} {
                if {[catch {my TakeEvent $Event}]} {
                    my Lost
                }
                set Event {}
            } elseif {[regexp {^(event|data): ?(.*)$} $line -> field value]} {
                dict set Event $field $value
            }
        }
        if {$Events ne "" && (
            [catch {eof $Events} over] || $over || [chan pending input $Events] > $::genomix::http::longestEvent
        )} {
            my Lost
        }
    }

    method TakeEvent {event} {
        set event [dict merge {event {} data {}} $event]
        switch -- [dict get $event event] {
            request {
                set id [dict get $event data id]
                if {[dict exists $Requests $id]} {
                    [dict get $Requests $id] update [dict get $event data]
                }
            }
            quit {
                my Lost
            }
        }
    }

    # The server is gone, and with it all word of what is under way.
    method Lost {} {
        catch {close $Events}
        set Events ""
        set what "the connection to genomixd at $Host:$Port is lost"
        set status [dict create status error exception [dict create ex ::genom::mwerr detail [dict create what $what]]]
        set aloud 1 ;# once is enough
        foreach request [dict values $Requests] {
            set aloud [expr {![$request update $status $aloud] && $aloud}]
        }
    }
}
