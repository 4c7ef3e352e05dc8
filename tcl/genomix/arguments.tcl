# The arguments of a service as JSON. The server checks names and types; here is only what Tcl's syntax leaves open.

# The JSON object for the words of a call: nothing, one dict of parameters, or values by position; for a composite, the
# first value and a dict of all others.
proc ::genomix::Input {service about words} {
    set parameters [dict get $about parameters]
    if {[dict get $about composite] && [llength $words] > 1} {
        set pairs [::genomix::FirstAndDict $service $parameters $words]
    } elseif {[llength $words] == 1 && [::genomix::IsDict $service $parameters [lindex $words 0]]} {
        set pairs [lindex $words 0]
    } else {
        if {[llength $words] > [dict size $parameters]} {
            ::genomix::Refuse "$service: [llength $words] arguments are too many;\
                it takes [::genomix::Listed [dict keys $parameters]]"
        }
        set pairs {}
        foreach value $words name [lrange [dict keys $parameters] 0 [llength $words]-1] {
            lappend pairs $name $value
        }
    }
    set members {}
    foreach {name value} $pairs {
        lappend members [::genomix::JsonString $name]:[::genomix::JsonValue $parameters $name $value]
    }
    return "{[join $members ,]}"
}

# The pairs of names and values of the words `first {name value ...}`.
proc ::genomix::FirstAndDict {service parameters words} {
    lassign $words first others
    set name [lindex $parameters 0]
    if {[llength $words] > 2 || [catch {dict size $others}]} {
        ::genomix::Refuse "$service: after $name comes a dict of parameters, and not \"[lrange $words 1 end]\""
    }
    return [list $name $first {*}$others]
}

# Whether the only word of a call is a dict of parameters, and not the value of the first one: its keys are names of
# parameters, or at least look like names, so that a misspelt one is told and not taken for a value.
proc ::genomix::IsDict {service parameters word} {
    if {[catch {llength $word} length]} {
        return 0
    }
    if {$length < 2} {
        return [expr {$length == 0}]
    }
    lassign {0 1} known names
    foreach {name value} $word {
        incr known [::genomix::IsParameter $parameters $name]
        set names [expr {$names && [regexp {^[A-Za-z_]\w*$} $name]}]
    }
    if {$known && $length % 2} {
        ::genomix::Refuse "$service: [lindex $word end] has no value in \"$word\""
    }
    return [expr {$length % 2 == 0 && ($known || $names)}]
}

proc ::genomix::IsParameter {parameters name} {
    return [expr {[::genomix::Parameter $parameters $name] ne ""}]
}

# What is known about a parameter, by its name or an alias; empty for none.
proc ::genomix::Parameter {parameters name} {
    if {[dict exists $parameters $name]} {
        return [dict get $parameters $name]
    }
    foreach about [dict values $parameters] {
        if {$name in [dict values [dict get $about aliases]]} {
            return $about
        }
    }
    return ""
}

proc ::genomix::JsonValue {parameters name value} {
    set about [::genomix::Parameter $parameters $name]
    if {$about eq "" || ![string match sequence<* [dict get $about type]]} {
        return [::genomix::JsonString $value]
    }
    if {[catch {::genomix::Elements $value} elements]} {
        ::genomix::Refuse "$name: \"$value\" is not a list ([dict get $about type])"
    }
    return "\[[join [lmap element $elements {::genomix::JsonString $element}] ,]\]"
}

# The elements of a sequence given as an index dict {0 a 1 b}, or as a list where the keys are no indexes.
proc ::genomix::Elements {value} {
    set length [llength $value]
    if {$length % 2 == 0} {
        set elements [lrepeat [expr {$length / 2}] {}]
        set indexes {}
        foreach {index element} $value {
            if {![string is entier -strict $index] || $index < 0 || $index >= $length / 2} {
                return [lrange $value 0 end]
            }
            lset elements $index $element
            dict set indexes [expr {$index}] 1
        }
        if {[dict size $indexes] == $length / 2} {
            return $elements
        }
    }
    return [lrange $value 0 end]
}

proc ::genomix::JsonString {text} {
    set text [string map {\\ \\\\ \" \\\" \n \\n \r \\r \t \\t} $text]
    if {[regexp {[\x00-\x1f]} $text]} {
        set escaped ""
        foreach character [split $text ""] {
            scan $character %c code
            append escaped [expr {$code < 32 ? [format \\u%04x $code] : $character}]
        }
        set text $escaped
    }
    return "\"$text\""
}
