# HTTP GET for genomix: one kept connection per client, on which calls wait without serving events. What is at the other
# end may be no genomixd: nothing is read without a bound, and no size is believed.

namespace eval ::genomix::http {
    variable encoded ;# what each byte becomes in a URL
    variable longestLine 65536 ;# characters of a header
    variable longestEvent [expr {1 << 24}] ;# bytes of one
    variable largest [expr {1 << 30}] ;# bytes of an answer
    variable piece [expr {1 << 18}] ;# bytes read at a time
    variable patience 1000 ;# ms, then a person at a terminal is told how far an answer has come
}

apply {{} {
    variable encoded
    for {set byte 0} {$byte < 256} {incr byte} {
        set character [format %c $byte]
        set plain [string match {[A-Za-z0-9_.~-]} $character]
        set encoded($character) [expr {$plain ? $character : [format %%%02X $byte]}]
    }
} ::genomix::http}

# A text as part of a URL.
proc ::genomix::http::encode {text} {
    variable encoded
    set out ""
    foreach character [split [encoding convertto utf-8 $text] ""] {
        append out $encoded($character)
    }
    return $out
}

# The path and query of a URL; words are the parts of the path, query is a dict.
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

# A new connection.
proc ::genomix::http::open {host port} {
    if {[catch {socket $host $port} channel]} {
        ::genomix::Refuse "no genomixd at $host:$port ($channel)" ::genom::mwerr
    }
    fconfigure $channel -translation binary -buffersize 1000000
    return $channel
}

# Whether a kept connection can be used again: the server has neither closed it nor said anything unasked.
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

# The next line, without its end.
proc ::genomix::http::line {channel} {
    variable longestLine
    set line ""
    while 1 {
        # What has come of it, and then the next character, so that one without an end is noticed.
        fconfigure $channel -blocking 0
        set whole [expr {[gets $channel rest] >= 0}]
        set length [expr {[string length $line] + [chan pending input $channel]}]
        fconfigure $channel -blocking 1
        if {$whole} {
            return [string trimright $line$rest \r]
        }
        if {$length > $longestLine} {
            error "a line without an end"
        }
        set next [read $channel 1]
        switch -- $next {
            "" {error "the connection ended before an answer came"}
            "\n" {return [string trimright $line \r]}
        }
        append line $next
    }
}

# The status code and the headers (names in lower case) of the answer that comes.
proc ::genomix::http::head {channel} {
    if {![regexp {^HTTP/1\.[01] (\d{3})} [line $channel] -> status]} {
        error "no answer of a genomixd"
    }
    set headers {}
    for {set count 0} {[set line [line $channel]] ne ""} {incr count} {
        if {$count == 100} {
            error "headers without an end"
        }
        if {[regexp {^([^:]+):\s*(.*)$} $line -> name value]} {
            dict set headers [string tolower $name] $value
        }
    }
    return [list $status $headers]
}

# The text that follows a head. A person at a terminal is told how far it has come, of `what`, if it takes long.
proc ::genomix::http::body {channel headers what} {
    variable largest
    variable piece
    set begun [clock milliseconds]
    lassign {0 0 0} told last taken
    set body [binary format {}] ;# bytes, to which bytes are appended without a look at all that is there
    try {
        while {!$last} {
            if {[dict exists $headers content-length]} {
                set known [regexp {^\d{1,10}$} [dict get $headers content-length] size]
                set last 1
            } elseif {[set known [regexp {^([[:xdigit:]]{1,8})\s*(?:;|$)} [line $channel] -> size]]} {
                scan $size %x size
                set last [expr {$size == 0}]
            }
            if {!$known || $size > $largest - $taken} {
                error "an answer of no size that there is"
            }
            while {$size > 0} {
                set part [read $channel [expr {min($size, $piece)}]]
                if {$part eq ""} {
                    error "the connection ended within an answer"
                }
                append body $part
                incr taken [string length $part]
                incr size -[string length $part]
                set told [tell $what $begun $told $taken]
            }
            if {![dict exists $headers content-length]} {
                line $channel
            }
        }
    } finally {
        if {$told} {
            puts -nonewline stderr "\r\033\[K"
        }
    }
    return [encoding convertfrom utf-8 $body]
}

# Tell how much has come on a line of its own; when that was done the last time.
proc ::genomix::http::tell {what begun told bytes} {
    variable patience
    set now [clock milliseconds]
    if {$now - $begun < $patience || $now - $told < 200 || [catch {fconfigure stderr -mode}]} {
        return $told ;# it is early, or nobody looks: only terminals have a mode
    }
    puts -nonewline stderr [format "\r%s: %.1f MB in %.0f s" $what [expr {$bytes / 1e6}] [expr {($now - $begun) / 1e3}]]
    return $now
}
