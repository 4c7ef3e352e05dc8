# Requests in the background: commands that tell what has become of a request, and of its result.

oo::class create ::genomix::Request {
    # Client: the handle it went through.   Id: the server's name for it.   Status: sent, done or error.
    # Output: the result, once it is here.   Exception: the error, as a dict.   Callback: a command prefix, or empty.
    # Changed: written at the end and when patience ends; `wait` waits for that.
    variable Client Id Status Output Exception Callback Changed

    constructor {client callback} {
        lassign [list $client $callback] Client Callback
        lassign {{} sent {} {} 0} Id Status Output Exception Changed
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
        return $Status
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

    # Take what the server says.
    method update {told} {
        if {[dict exists $told id]} {
            set Id [dict get $told id]
        }
        if {$Status ne "sent" || [dict get $told status] eq "sent"} {
            return
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
        }
    }
}
