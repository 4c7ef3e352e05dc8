# What an interactive shell needs: what a command takes, and the values that a user types for a call without arguments.

# genomix::about command
#
# {service parameters switches values} or {port {} switches {}} for a command of a component, empty for any other; of a
# composite, values are what its first word can be, after which comes the dict of parameters.
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

# Whether the user shall be asked for the arguments of a call: eltclsh says whether it was typed there, and a `--` says
# that there are none.
proc ::genomix::Asks {arguments words parameters} {
    return [expr {
        ![llength $words] && [dict size $parameters] && "--" ni $arguments
        && [info commands ::el::typing] ne "" && [uplevel 1 ::el::typing]
    }]
}

# A dict of what the user types for each parameter, of a composite only for those without a default; nothing typed means
# the default.
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
