# HTTP GET for genomix: one kept connection per client, on which calls wait without serving events.

namespace eval ::genomix::http {
    variable encoded ;# what each byte becomes in a URL
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

# The status code and the headers (names in lower case) of the answer that comes.
proc ::genomix::http::head {channel} {
    if {[gets $channel line] < 0 || ![regexp {^HTTP/1\.[01] (\d{3})} $line -> status]} {
        error "the connection ended before an answer came"
    }
    set headers {}
    while {[gets $channel line] >= 0 && [set line [string trimright $line \r]] ne ""} {
        if {[regexp {^([^:]+):\s*(.*)$} $line -> name value]} {
            dict set headers [string tolower $name] $value
        }
    }
    return [list $status $headers]
}

# The text that follows a head.
proc ::genomix::http::body {channel headers} {
    if {[dict exists $headers content-length]} {
        set length [dict get $headers content-length]
        set body [read $channel $length]
        if {[string length $body] != $length} {
            error "the connection ended within an answer"
        }
        return [encoding convertfrom utf-8 $body]
    }
    set body ""
    while 1 {
        if {[gets $channel size] < 0 || [scan $size %x size] != 1} {
            error "the connection ended within an answer"
        }
        append body [read $channel $size]
        gets $channel
        if {$size == 0} {
            return [encoding convertfrom utf-8 $body]
        }
    }
}
