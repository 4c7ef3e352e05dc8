# Procedures of eltclsh: exit, the question after Ctrl-C, and procedures for scripts of the original.

namespace eval ::el {
    variable completionPatterns {
        {^(::)?cd$ {p 1 d}}
        {^(::)?(source|load|open)$ {p 1 F}}
        {^(::)?(set|unset|incr|append|lappend|lassign|vwait|global|variable|upvar|foreach)$ {p 1 v}}
        {^(::)?(close|eof|fblocked|fconfigure|fileevent|flush|gets|read|seek|tell)$ {p 1 {[file channels]}}}
        {^(::)?package$ {p 1 {forget ifneeded names present provide require unknown vcompare versions vsatisfies}}
            {n ^(present|require|forget|versions)$ k}}
        {^(::)?after$ {p 1 {cancel idle info}}}
        {^(::)?interp$ {p 1 {alias aliases create delete eval exists expose hide hidden slaves}}}
        {^(::)?trace$ {p 1 {add info remove}} {p 2 {command execution variable}}}
        {^(::)?signal$ {p 1 {[signal names]}} {c ^- {-default -ignore -block -unblock}}}
        {^(::)?el::history$ {p 1 {add change clear event file save size}}}
    }
    variable queryItems 100
    variable maxCols 0
    variable typed 0 ;# 1 while a command from the prompt is running
}

# Return whether the command that called our caller was typed at the prompt. Only then may it ask for parameters.
proc ::el::typing {} {
    variable typed
    return [expr {$typed && [info level] <= 2 && [info script] eq ""}]
}

proc ::exit {{returnCode 0}} {
    if {![string is entier -strict $returnCode]} {
        return -code error "expected integer but got \"$returnCode\""
    }
    ::el::Exit [expr {$returnCode & 0xff}]
}

# Handle Ctrl-C at the prompt, or while a command from the prompt is running.
proc ::el::interrupted {} {
    chan puts "\n*** Got signal SIGINT"
    while 1 {
        set answer [::el::Key "*** Choose 1: continue, 2: exit, 3: back to the prompt > "]
        chan puts [expr {[string is print $answer] ? $answer : ""}]
        switch -- $answer {
            1 {
                return [::el::Redisplay]
            }
            2 {
                exit
            }
            3 - \u0003 {
                return [::el::Cancel]
            }
        }
    }
}

# shift varName: remove the first element of a list and return it.
proc ::shift {varName} {
    upvar 1 $varName list
    set list [lassign $list first]
    return $first
}

# wrappedputs line width: print a text in lines of at most `width` characters, broken between words.
proc ::wrappedputs {line width} {
    if {![string is entier -strict $width] || $width < 1} {
        return -code error "expected a width above 0 but got \"$width\""
    }
    while {[string length $line] > $width} {
        set break [string last " " $line $width]
        if {$break <= 0} {
            puts [string range $line 0 $width-1]
            set line [string range $line $width end]
        } else {
            puts [string range $line 0 $break-1]
            set line [string range $line $break+1 end]
        }
    }
    puts $line
}

# aska type prompt default ?arg?: ask the user until the answer is a value of the type: bool, short, int, wide, float,
# double, string, or a list of choices. An empty answer or a dot selects the default; `arg` is used as the first answer.
proc ::aska {type prompt default args} {
    if {[llength $args] > 1} {
        return -code error {wrong # args: should be "aska type prompt default ?arg?"}
    }
    while 1 {
        if {[llength $args]} {
            set input [lindex $args 0]
            set args {}
        } else {
            set input [::el::Choose $type "$prompt \[$default\]> "]
        }
        if {$input in {"" .}} {
            set input $default
        }
        if {![catch {::el::Value $type $input} value]} {
            return $value
        }
        puts "expecting [::el::Expected $type] but got $input"
    }
}

# As el::gets, with completion of the choices of an enumeration.
proc ::el::Choose {type prompt} {
    variable completionPatterns
    if {[::el::Expected $type] ne "enum {$type}"} {
        return [::el::gets $prompt]
    }
    set before $completionPatterns
    set completionPatterns [list [list {} [list c {} $type]]]
    try {
        return [::el::gets $prompt]
    } finally {
        set completionPatterns $before
    }
}

proc ::el::Expected {type} {
    switch -regexp -- $type {
        ^bool {return boolean}
        ^(short|int)$ {return integer}
        ^wide$ {return "wide integer"}
        ^(float|double)$ {return $type}
        {^(string|char\s?\*)$} {return string}
        default {return "enum {$type}"}
    }
}

# Convert an answer to a value of the type, or raise an error. Numbers may be expressions.
proc ::el::Value {type input} {
    switch -- [::el::Expected $type] {
        boolean {return [expr {bool($input)}]}
        integer - "wide integer" {
            set value [uplevel #0 [list expr $input]]
            if {$value != entier($value)} {error "not an integer"}
            return [expr {entier($value)}]
        }
        float - double {return [expr {double([uplevel #0 [list expr $input]])}]}
        string {return [string trim $input]}
        default {
            set input [string trim $input]
            if {$input ni $type} {error "not one of the choices"}
            return $input
        }
    }
}

# mapscan format words: return a value for each line {?opt? type prompt default} of the format: the next word. After the
# last word, it is the default of an optional value, or the answer of the user. After "..", defaults are used.
proc ::mapscan {format words} {
    set values {}
    set defaults 0
    foreach line $format {
        set optional [expr {[llength $line] == 4 && [lindex $line 0] eq "opt"}]
        if {[llength $line] != 3 + $optional} {
            return -code error "bad format $line: should be \"{ ?opt? type prompt default }\""
        }
        lassign [lrange $line $optional end] type prompt default
        if {!$defaults && [lindex $words 0] eq ".."} {
            shift words
            set defaults 1
        }
        if {$defaults || ($optional && ![llength $words])} {
            set given [list $default]
        } elseif {[llength $words]} {
            set given [list [shift words]]
        } else {
            set given {}
        }
        lappend values [uplevel #0 [list aska $type $prompt $default {*}$given]]
    }
    if {[llength $words]} {
        puts "warning: ignoring extra args \"$words\""
    }
    return $values
}
