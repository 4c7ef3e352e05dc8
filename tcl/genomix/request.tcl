# Requests in the background: commands that tell what has become of a request, and of its result.

oo::class create ::genomix::Request {
    # Client: the handle it went through.   Command: what was called.   Id: the server's name for it.
    # Status: sent, done or error.   Output: the result, once it is here.   Exception: the error, as a dict.
    # Callback: a command prefix, or empty.   Changed: written at the end and when patience ends; `wait` waits for that.
    # Seen: whether somebody has asked for the status since the end.   Timer: what will tell of an error, or empty.
    # Warning: of the component, or empty.   Made: when it was made, in ms.
    variable Client Command Id Status Output Exception Callback Changed Seen Timer Warning Made

    constructor {client command callback} {
        lassign [list $client $command $callback] Client Command Callback
        lassign {{} sent {} {} 0 0 {} {}} Id Status Output Exception Changed Seen Timer Warning
        set Made [clock milliseconds]
    }

    destructor {
        after cancel $Timer
        dict unset ::genomix::failed [self]
    }

    # id
    #
    # The request's id, such as rosAFE::3.
    method id {} {
        return $Id
    }

    # status
    #
    # sent until the request ends, then done or error.
    method status {} {
        if {$Status eq "sent"} {
            $Client poll
        }
        set Seen [expr {$Status ne "sent"}]
        return $Status
    }

    # result
    #
    # The result, a dict. Raises the request's error where it failed, and ::genomix::e_notDone before its end.
    method result {} {
        switch -- [my status] {
            sent {::genomix::Refuse "$Id is not done yet" ::genomix::e_notDone}
            error {::genomix::Raise $Exception}
        }
        if {$Output eq "large"} {
            set Output [list here [$Client get {request result} [dict create id $Id]]]
        }
        return [lindex $Output 1]
    }

    # warning
    #
    # What the component has to say of a request that it grants all the same: a word that it does not know, say.
    method warning {} {
        if {$Status eq "sent"} {
            $Client poll
        }
        return $Warning
    }

    # wait ?ms?
    #
    # Serve events until the request ends, or for so many milliseconds, and return its status.
    method wait {{ms ""}} {
        if {$ms ne "" && (![string is entier -strict $ms] || $ms < 0)} {
            ::genomix::Refuse "wait: \"$ms\" is not a number of milliseconds"
        }
        set timer ""
        if {$ms ne ""} {
            set timer [after $ms [list set [namespace current]::Changed late]]
        }
        while {[my status] eq "sent" && $Changed ne "late"} {
            vwait [namespace current]::Changed
        }
        after cancel $timer
        set Changed 0
        return [my status]
    }

    # abort
    #
    # Ask the component to end the activity; the request is done when it has.
    method abort {} {
        $Client get {request abort} [dict create id $Id]
        return
    }

    # clean
    #
    # Forget the request; what it started goes on.
    method clean {} {
        $Client forget $Id
        catch {$Client get {request clean} [dict create id $Id]}
        my destroy
    }

    # --- for the client ---

    # Take what the server says. An error that nobody looks at, nor any callback, is told; 1 where that may happen.
    method update {told {aloud 1}} {
        if {[dict exists $told id]} {
            set Id [dict get $told id]
        }
        if {$Warning eq "" && [dict exists $told warning]} {
            set Warning [dict get $told warning]
            if {$::tcl_interactive} {
                puts stderr "$Command &: warning: [::genomix::OneLine $Warning]"
            }
        }
        if {$Status ne "sent" || [dict get $told status] eq "sent"} {
            return 0
        }
        set Status [dict get $told status]
        if {$Status eq "error"} {
            set Exception [dict get $told exception]
        } elseif {[dict exists $told output]} {
            set Output [list here [dict get $told output]]
        } else {
            set Output large
        }
        $Client forget $Id
        set Changed 1
        if {$Callback ne ""} {
            # As an event of its own: an error in it is the callback's, and goes to bgerror.
            after 0 [list {*}$Callback [self]]
        } elseif {$aloud && $Status eq "error"} {
            set Timer [after $::genomix::attention [namespace code {my Complain}]]
            dict set ::genomix::failed [self] 1
            return 1
        }
        return 0
    }

    # Tell of the error now, where nobody serves events: at the prompt of tclsh.
    method overdue {} {
        if {[clock milliseconds] - $Made >= $::genomix::attention} {
            after cancel $Timer
            my Complain
        }
    }

    # As Tcl tells of errors in the background, in one line.
    method Complain {} {
        dict unset ::genomix::failed [self]
        if {$Seen} {
            return
        }
        set ex [dict get $Exception ex]
        set detail [expr {[dict exists $Exception detail] ? [dict get $Exception detail] : {}}]
        set message "$Command &: $ex"
        if {![catch {dict get $detail what} what] || ![catch {dict get $Exception what} what]} {
            append message ": $what"
        }
        set message [::genomix::OneLine $message]
        {*}[interp bgerror {}] $message \
            [dict create -code 1 -level 0 -errorcode [list GENOM $ex $detail] -errorinfo $message]
    }
}
