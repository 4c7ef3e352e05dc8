# HTTP GET for genomix: one persistent connection per client; calls wait without processing events. The server may be
# another program, therefore all sizes are limited.

namespace eval ::genomix::http {
    variable encoded ;# the encoding of each byte in a URL
    variable maxLine 65536 ;# characters of a header
    variable maxEvent [expr {1 << 24}] ;# bytes of an event
    variable maxAnswer [expr {1 << 30}] ;# bytes of an answer
    variable readSize [expr {1 << 18}] ;# bytes per read
    variable progressDelay 1000 ;# ms until the progress of an answer is shown on a terminal
}

apply {{} {
    variable encoded
    for {set byte 0} {$byte < 256} {incr byte} {
        set character [format %c $byte]
        set plain [string match {[A-Za-z0-9_.~-]} $character]
        set encoded($character) [expr {$plain ? $character : [format %%%02X $byte]}]
    }
} ::genomix::http}

# Encode a text as a part of a URL.
proc ::genomix::http::encode {text} {
    variable encoded
    set out ""
    foreach character [split [encoding convertto utf-8 $text] ""] {
        append out $encoded($character)
    }
    return $out
}

# Return path and query of a URL; words are the parts of the path, query is a dict.
proc ::genomix::http::url {words query} {
    set path ""
    foreach word $words {
        append path / [encode $word]
    }
    set pairs {}
    dict for {key value} $query {
        lappend pairs [encode $key]=[encode $value]
    }
    return $path?[join $pairs &]
}

# Open a connection.
proc ::genomix::http::open {host port} {
    if {[catch {socket $host $port} channel]} {
        ::genomix::Refuse "no genomixd at $host:$port ($channel)" ::genom::mwerr
    }
    fconfigure $channel -translation binary -buffersize 1000000
    return $channel
}

# Return whether a connection can be used again: the server has neither closed it nor sent unexpected data.
proc ::genomix::http::alive {channel} {
    fconfigure $channel -blocking 0
    set alive [expr {![catch {read $channel 1} text] && $text eq "" && ![eof $channel]}]
    fconfigure $channel -blocking 1
    return $alive
}

proc ::genomix::http::send {channel host port url {version 1.1}} {
    set host [expr {[string match *:* $host] ? "\[$host\]" : $host}]
    puts -nonewline $channel "GET $url HTTP/$version\r\nHost: $host:$port\r\nUser-Agent: tcl-genomix/1.8\r\n\r\n"
    flush $channel
}

# Read the next line without its end.
proc ::genomix::http::line {channel} {
    variable maxLine
    set line ""
    while 1 {
        # Read the available part of the line, then one character, so that an endless line is detected.
        fconfigure $channel -blocking 0
        set whole [expr {[gets $channel rest] >= 0}]
        set length [expr {[string length $line] + [chan pending input $channel]}]
        fconfigure $channel -blocking 1
        if {$whole} {
            return [string trimright $line$rest \r]
        }
        if {$length > $maxLine} {
            error "expected a line of at most $maxLine characters, got a longer one"
        }
        set next [read $channel 1]
        switch -- $next {
            "" {error "the connection was closed before the answer"}
            "\n" {return [string trimright $line \r]}
        }
        append line $next
    }
}

# Read the status code and the headers (names in lower case) of an answer.
proc ::genomix::http::head {channel} {
    if {![regexp {^HTTP/1\.[01] (\d{3})} [line $channel] -> status]} {
        error "expected an HTTP answer of genomixd, got other data"
    }
    set headers {}
    for {set count 0} {[set line [line $channel]] ne ""} {incr count} {
        if {$count == 100} {
            error "expected at most 100 headers, got more"
        }
        if {[regexp {^([^:]+):\s*(.*)$} $line -> name value]} {
            dict set headers [string tolower $name] $value
        }
    }
    return [list $status $headers]
}

# Read the body of an answer. If it takes long, show the progress of `what` on a terminal.
proc ::genomix::http::body {channel headers what} {
    variable maxAnswer
    variable readSize
    set started [clock milliseconds]
    lassign {0 0 0} shown last received
    set body [binary format {}] ;# a byte array, to which bytes are appended without conversion
    try {
        while {!$last} {
            if {[dict exists $headers content-length]} {
                set known [regexp {^\d{1,10}$} [dict get $headers content-length] size]
                set last 1
            } elseif {[set known [regexp {^([[:xdigit:]]{1,8})\s*(?:;|$)} [line $channel] -> size]]} {
                scan $size %x size
                set last [expr {$size == 0}]
            }
            if {!$known || $size > $maxAnswer - $received} {
                error "expected a size of at most $maxAnswer bytes, got another one"
            }
            while {$size > 0} {
                set part [read $channel [expr {min($size, $readSize)}]]
                if {$part eq ""} {
                    error "the connection was closed within the answer"
                }
                append body $part
                incr received [string length $part]
                incr size -[string length $part]
                set shown [showProgress $what $started $shown $received]
            }
            if {![dict exists $headers content-length]} {
                line $channel
            }
        }
    } finally {
        if {$shown} {
            puts -nonewline stderr "\r\033\[K"
        }
    }
    return [encoding convertfrom utf-8 $body]
}

# Show the received amount in one line; return the time when it was last shown.
proc ::genomix::http::showProgress {what started shown bytes} {
    variable progressDelay
    set now [clock milliseconds]
    if {$now - $started < $progressDelay || $now - $shown < 200 || [catch {fconfigure stderr -mode}]} {
        return $shown ;# too early, or stderr is not a terminal, which has a mode
    }
    set seconds [expr {($now - $started) / 1e3}]
    puts -nonewline stderr [format "\r%s: %.1f MB in %.0f s" $what [expr {$bytes / 1e6}] $seconds]
    return $now
}
