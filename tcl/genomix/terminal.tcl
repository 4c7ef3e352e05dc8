# Support for interactive shells: the arguments of commands, and questions for the parameters of a call.

# genomix::about command
#
# Return {service parameters switches values} or {port {} switches {}} for a command of a component, and an empty string
# for others. The first word of a composite is one of the values; a dict of parameters follows it.
proc ::genomix::about {command} {
    set name [namespace eval :: [list namespace which -command $command]]
    if {$name eq "" || [catch {interp alias {} $name} alias]} {
        return
    }
    set switches {-help -send -ack -oneway --}
    lassign $alias kind client component entry
    switch -- $kind {
        ::genomix::Service {
            set about [dict get [$client description $component] services $entry]
            set parameters [dict get $about parameters]
            set values {}
            if {[dict get $about composite]} {
                set values [dict values [dict get $parameters [lindex $parameters 0] choices]]
            }
            return [list service [dict keys $parameters] $switches $values]
        }
        ::genomix::Port {
            return [list port {} $switches {}]
        }
    }
    return
}

# Return whether to ask the user for the arguments of a call: if it was typed at the prompt of eltclsh, has no arguments
# and no `--`.
proc ::genomix::AsksForArguments {arguments words parameters} {
    return [expr {
        ![llength $words] && [dict size $parameters] && "--" ni $arguments
        && [info commands ::el::typing] ne "" && [uplevel 1 ::el::typing]
    }]
}

# Ask the user for each parameter, of a composite only for those without a default, and return a dict. An empty answer
# selects the default.
proc ::genomix::Ask {service} {
    set given {}
    dict for {name about} [dict get $service parameters] {
        if {[dict get $service composite] && ![dict get $about required]} {
            continue
        }
        set doc [dict get $about doc]
        set prompt "[dict get $about type] $name[expr {$doc ne "" ? ": $doc" : ""}]"
        if {![dict get $about required]} {
            append prompt " ([dict get $about default])"
        }
        while 1 {
            set value [::el::gets "$prompt > "]
            if {$value ne ""} {
                dict set given $name $value
            } elseif {[dict get $about required]} {
                puts "$name has no default"
                continue
            }
            break
        }
    }
    return $given
}
