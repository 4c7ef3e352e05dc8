# Conversion of the arguments of a service to JSON. The server checks names and types.

# Return the words of a call as a JSON object. The words are a dict of parameters, values by position, or none. For a
# composite, they are the first value and a dict of the others.
proc ::genomix::Input {service about words} {
    set parameters [dict get $about parameters]
    if {[dict get $about composite] && [llength $words] > 1} {
        set pairs [::genomix::FirstAndDict $service $parameters $words]
    } elseif {[llength $words] == 1 && [::genomix::IsDict $service $parameters [lindex $words 0]]} {
        set pairs [lindex $words 0]
    } else {
        if {[llength $words] > [dict size $parameters]} {
            ::genomix::Refuse "$service: expected at most [dict size $parameters] arguments\
                ([::genomix::Listed [dict keys $parameters]]), got [llength $words]"
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

# Return names and values for the words `first {name value ...}`.
proc ::genomix::FirstAndDict {service parameters words} {
    lassign $words first others
    set name [lindex $parameters 0]
    if {[llength $words] > 2 || [catch {dict size $others}]} {
        ::genomix::Refuse "$service: expected a dict of parameters after $name, got \"[lrange $words 1 end]\""
    }
    return [list $name $first {*}$others]
}

# Return whether the only word of a call is a dict of parameters, and not the value of the first parameter: its keys are
# parameters or look like names. A misspelt name is therefore reported and not used as a value.
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
        ::genomix::Refuse "$service: expected a value for [lindex $word end], got \"$word\""
    }
    return [expr {$length % 2 == 0 && ($known || $names)}]
}

proc ::genomix::IsParameter {parameters name} {
    return [expr {[::genomix::Parameter $parameters $name] ne ""}]
}

# Return the description of a parameter by its name or an alias, or an empty string.
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
        ::genomix::Refuse "$name: expected a list ([dict get $about type]), got \"$value\""
    }
    return "\[[join [lmap element $elements {::genomix::JsonString $element}] ,]\]"
}

# Return the elements of a sequence: an index dict {0 a 1 b}, or a list if the keys are not indexes.
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
