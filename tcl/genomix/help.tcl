# The output of -h: parameters with type, default, range and description.

proc ::genomix::ServiceHelp {name service about} {
    set lines [list "${name}::$service: [dict get $about doc]"]
    if {[dict get $about composite]} {
        lappend lines "  ${name}::$service [lindex [dict get $about parameters] 0] ?{parameter value ...}?"
    }
    dict for {parameter description} [dict get $about parameters] {
        set line "  $parameter ([dict get $description type]"
        if {[dict get $description required]} {
            append line ", no default"
        } else {
            append line ", default [list [dict get $description default]]"
        }
        if {[dict get $description range] ne ""} {
            append line ", [dict get $description range]"
        }
        lappend lines "$line): [dict get $description doc]"
    }
    if {![dict size [dict get $about parameters]]} {
        lappend lines "  no parameters"
    }
    dict for {output type} [dict get $about outputs] {
        lappend lines "  returns $output ($type)"
    }
    if {[dict get $about activity]} {
        lappend lines "  an activity: returns when it is running, or immediately with &; runs until it is stopped"
    }
    foreach error [dict values [dict get $about throws]] {
        lappend lines "  may fail with $error"
    }
    return [join $lines \n]
}

proc ::genomix::PortHelp {name port about} {
    set element [expr {[dict get $about multiple] ? " element" : ""}]
    set lines [list "${name}::$port$element: [dict get $about doc]" "  returns $port ([dict get $about type])"]
    if {![dict get $about output]} {
        lset lines 1 "  an input port: connect it with connect_port"
    }
    return [join $lines \n]
}

# Return {a b c} as "a, b, c", and an empty list as "no parameters".
proc ::genomix::Listed {names} {
    return [expr {[llength $names] ? [join $names ", "] : "no parameters"}]
}
