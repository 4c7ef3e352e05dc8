# What -h tells: parameters with type, default, range and text.

proc ::genomix::ServiceHelp {name service about} {
    set lines [list "${name}::$service: [dict get $about doc]"]
    if {[dict get $about composite]} {
        lappend lines "  ${name}::$service [lindex [dict get $about parameters] 0] ?{parameter value ...}?"
    }
    dict for {parameter told} [dict get $about parameters] {
        set line "  $parameter ([dict get $told type]"
        if {[dict get $told required]} {
            append line ", no default"
        } else {
            append line ", default [list [dict get $told default]]"
        }
        if {[dict get $told range] ne ""} {
            append line ", [dict get $told range]"
        }
        lappend lines "$line): [dict get $told doc]"
    }
    if {![dict size [dict get $about parameters]]} {
        lappend lines "  no parameters"
    }
    dict for {output type} [dict get $about outputs] {
        lappend lines "  returns $output ($type)"
    }
    if {[dict get $about activity]} {
        lappend lines "  an activity: returns once it runs, with & at once; goes on until it is stopped"
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
        lset lines 1 "  an input port: connect_port connects it"
    }
    return [join $lines \n]
}

# {a b c} as "a, b, c"; "no parameters" for none.
proc ::genomix::Listed {names} {
    return [expr {[llength $names] ? [join $names ", "] : "no parameters"}]
}
