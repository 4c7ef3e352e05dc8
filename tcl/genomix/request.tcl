# Background requests: commands that return the status and the result of a request.

oo::class create ::genomix::Request {
    # Client: the handle.   Command: the command that was called.   Id: the id given by the server.
    # Status: sent, done or error.   Output: the result, when it has been received.   Exception: the error, as a dict.
    # Callback: a command prefix, or empty.   Changed: written at the end and after a timeout; `wait` waits for it.
    # Seen: whether the status has been read since the end.   Timer: the timer that reports an error, or empty.
    # Warning: of the component, or empty.   Created: time of creation, ms.
    variable Client Command Id Status Output Exception Callback Changed Seen Timer Warning Created

    constructor {client command callback} {
        lassign [list $client $command $callback] Client Command Callback
        lassign {{} sent {} {} 0 0 {} {}} Id Status Output Exception Changed Seen Timer Warning
        set Created [clock milliseconds]
    }

    destructor {
        after cancel $Timer
        dict unset ::genomix::failed [self]
    }

    # id
    #
    # Return the id of the request, for example rosAFE::3.
    method id {} {
        return $Id
    }

    # status
    #
    # Return sent until the request ends, then done or error.
    method status {} {
        if {$Status eq "sent"} {
            $Client poll
        }
        set Seen [expr {$Status ne "sent"}]
        return $Status
    }

    # result
    #
    # Return the result, a dict. Raise the error of a failed request, and ::genomix::e_notDone before its end.
    method result {} {
        switch -- [my status] {
            sent {::genomix::Refuse "$Id is not finished yet" ::genomix::e_notDone}
            error {::genomix::Raise $Exception}
        }
        if {$Output eq "large"} {
            set Output [list here [$Client get {request result} [dict create id $Id]]]
        }
        return [lindex $Output 1]
    }

    # warning
    #
    # Return the component's warning about an accepted request, for example about an unknown choice; empty for none.
    method warning {} {
        if {$Status eq "sent"} {
            $Client poll
        }
        return $Warning
    }

    # wait ?ms?
    #
    # Process events until the request ends, or for at most `ms` milliseconds, and return its status.
    method wait {{ms ""}} {
        if {$ms ne "" && (![string is entier -strict $ms] || $ms < 0)} {
            ::genomix::Refuse "wait: expected a number of milliseconds, got \"$ms\""
        }
        set timer ""
        if {$ms ne ""} {
            set timer [after $ms [list set [namespace current]::Changed timeout]]
        }
        while {[my status] eq "sent" && $Changed ne "timeout"} {
            vwait [namespace current]::Changed
        }
        after cancel $timer
        set Changed 0
        return [my status]
    }

    # abort
    #
    # Ask the component to end the activity. The request is done when the activity has ended.
    method abort {} {
        $Client get {request abort} [dict create id $Id]
        return
    }

    # clean
    #
    # Forget the request. The activity that it has started continues.
    method clean {} {
        $Client forget $Id
        catch {$Client get {request clean} [dict create id $Id]}
        my destroy
    }

    # --- used by the client ---

    # Process a status of the server. Return 1 if the error of a request without a callback will be reported, unless the
    # status is read.
    method update {new {report 1}} {
        if {[dict exists $new id]} {
            set Id [dict get $new id]
        }
        if {$Warning eq "" && [dict exists $new warning]} {
            set Warning [dict get $new warning]
            if {$::tcl_interactive} {
                puts stderr "$Command &: warning: [::genomix::OneLine $Warning]"
            }
        }
        if {$Status ne "sent" || [dict get $new status] eq "sent"} {
            return 0
        }
        set Status [dict get $new status]
        if {$Status eq "error"} {
            set Exception [dict get $new exception]
        } elseif {[dict exists $new output]} {
            set Output [list here [dict get $new output]]
        } else {
            set Output large
        }
        $Client forget $Id
        set Changed 1
        if {$Callback ne ""} {
            # In a separate event: an error in the callback is reported to bgerror.
            after 0 [list {*}$Callback [self]]
        } elseif {$report && $Status eq "error"} {
            set Timer [after $::genomix::reportDelay [namespace code {my ReportError}]]
            dict set ::genomix::failed [self] 1
            return 1
        }
        return 0
    }

    # Report the error immediately: the prompt of tclsh does not process events.
    method overdue {} {
        if {[clock milliseconds] - $Created >= $::genomix::reportDelay} {
            after cancel $Timer
            my ReportError
        }
    }

    # Report the error in one line, as a background error of Tcl.
    method ReportError {} {
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
