# The handles genomix1, genomix2, ...: the connection to one genomixd, and the components loaded from it.

oo::class create ::genomix::Client {
    # Host Port: of the server.   Session: the name of our session.   Channel: the persistent connection, or empty.
    # Components: the description of each loaded component, by namespace.
    # Events: the connection for events of requests, or empty.   Event: the event that is being read.
    # Requests: the unfinished requests, by id.
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
    # Create commands for the services and ports of a running component in the namespace ::name, and return the name.
    # The default is the name of the instance, or of the component; an instance robot1/rosAFE is named robot1_rosAFE.
    method load {component args} {
        set query {}
        foreach {option value} $args {
            switch -- $option {
                -i {dict set query i $value}
                as {dict set query as $value}
                default {
                    ::genomix::Refuse "load: expected -i instance or as name, got \"$option\""
                }
            }
        }
        if {[llength $args] % 2} {
            ::genomix::Refuse "load: expected a value for [lindex $args end]"
        }
        set description [my get [list load $component] $query]
        if {[catch {dict get $description name} name]
            || [catch {dict size [dict get $description services]}] || [catch {dict size [dict get $description ports]}]
        } {
            ::genomix::Refuse "genomixd at $Host:$Port: expected the description of a component, got another answer" \
                ::genom::mwerr
        }
        if {![regexp {^[A-Za-z]\w*$} $name] || $name in {genomix oo tcl zlib el}} {
            ::genomix::Refuse "load: \"$name\" is not allowed as a namespace; choose another one with: as name"
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
    # Remove the commands of a component. The component continues to run.
    method unload {name} {
        if {![dict exists $Components $name]} {
            ::genomix::Refuse "unload: expected one of the loaded components ([dict keys $Components]), got \"$name\""
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
    # Accepted for scripts of the original, without effect. Components are found on the ROS graph.
    method rpath {dir} {
        return
    }

    # --- used by the other files of the package ---

    method description {name} {
        return [dict get $Components $name]
    }

    # Send GET /words...?query in our session and return the answer. Raise the errors of the component or of the server.
    method get {words {query {}}} {
        if {[lindex $words 0] in {call send}} {
            # The server loads the component again if it has been restarted.
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
            ::genomix::Refuse "genomixd at $Host:$Port: status $status: [string range $body 0 200]" ::genom::mwerr
        }
        ::genomix::Raise $body
    }

    method Disconnect {} {
        catch {close $Channel}
        set Channel ""
    }

    # --- background requests ---

    # Send a background request; words and query are those of the URL.
    method send {words query callback} {
        my Listen
        set request [::genomix::Request create ::genomix::request[incr ::genomix::requests] [self] \
            [join [lrange $words 1 2] ::] $callback]
        try {
            set status [my get $words $query]
            if {[catch {list [dict get $status id] [dict get $status status]}]} {
                ::genomix::Refuse "genomixd at $Host:$Port: expected the status of the request, got another answer" \
                    ::genom::mwerr
            }
        } on error {message options} {
            $request destroy
            return -options $options $message
        }
        dict set Requests [dict get $status id] $request
        $request update $status
        return $request
    }

    # Ignore further events of a request.
    method forget {id} {
        dict unset Requests $id
    }

    method Listen {} {
        if {$Events ne ""} {
            return
        }
        set Events [::genomix::http::open $Host $Port]
        # HTTP/1.0: the answer is not chunked.
        ::genomix::http::send $Events $Host $Port \
            [::genomix::http::url {session listen} [dict create s $Session syntax tcl]] 1.0
        if {[catch {::genomix::http::head $Events} head] || [lindex $head 0] != 200} {
            catch {close $Events}
            set Events ""
            ::genomix::Refuse "genomixd at $Host:$Port: no events are available: $head" ::genom::mwerr
        }
        fconfigure $Events -blocking 0
        fileevent $Events readable [namespace code {my ReadEvents}]
    }

    # Process the events that have been received.
    method poll {} {
        if {$Events ne ""} {
            my ReadEvents
        }
    }

    method ReadEvents {} {
        while {$Events ne "" && ![catch {gets $Events line} length] && $length >= 0} {
            set line [encoding convertfrom utf-8 [string trimright $line \r]]
            if {$line eq ""} {
                if {[catch {my HandleEvent $Event}]} {
                    my Lost
                }
                set Event {}
            } elseif {[regexp {^(event|data): ?(.*)$} $line -> field value]} {
                dict set Event $field $value
            }
        }
        if {$Events ne "" && (
            [catch {eof $Events} ended] || $ended || [chan pending input $Events] > $::genomix::http::maxEvent
        )} {
            my Lost
        }
    }

    method HandleEvent {event} {
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

    # Mark all unfinished requests as failed, because the connection to the server is lost.
    method Lost {} {
        catch {close $Events}
        set Events ""
        set what "the connection to genomixd at $Host:$Port is lost"
        set status [dict create status error exception [dict create ex ::genom::mwerr detail [dict create what $what]]]
        set report 1 ;# only the first one is reported
        foreach request [dict values $Requests] {
            set report [expr {![$request update $status $report] && $report}]
        }
    }
}
