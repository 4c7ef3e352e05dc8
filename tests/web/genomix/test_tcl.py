"""The Tcl package in tclsh, with a real genomixd and real nodes."""

from __future__ import annotations

import re
import subprocess

import pytest

from tests import harness
from tests.terminal import Terminal
from tests.web.genomix import world as worlds
from tests.web.genomix.world import World

pytestmark = pytest.mark.ros

# --- connections and components ---------------------------------------------------------------------------------


def test_the_package_has_a_version_and_no_side_effects_at_load(world: World) -> None:
    assert world.lines("""
        foreach name {byte character plain part root clients encoded} {set $name mine}
        set before ""
        set before [lsort [info globals]]
        package forget genomix
        namespace delete genomix
        show [package require genomix] [namespace exists ::rosAFE] [after info] [lsort [file channels]]
        show $byte $character $plain $part $root $clients $encoded [expr {[lsort [info globals]] eq $before}]
        namespace import ::genomix::*
        show [namespace origin connect] [namespace origin localhost]
    """) == [
        "1.8|0||stderr stdin stdout",
        "mine|mine|mine|mine|mine|mine|mine|1",
        "::genomix::connect|::genomix::localhost",
    ]


def test_handles_are_commands_by_their_literal_names(world: World) -> None:
    assert world.lines("""
        genomix::connect $address
        show [set second [genomix::connect $address]]
        show [genomix1 load bass] [$second load /opt/openrobots/lib/genom/ros/plugins/rosAFE.so]
        genomix1 rpath ~/openrobots/lib/genom/ros/plugins/
        show [bass::Stop] [info commands ::rosAFE::getSignals]
        $second unload rosAFE
        show [namespace exists ::rosAFE] [namespace exists ::bass]
        genomix1 destroy
        show [namespace exists ::bass] [info commands genomix1]
    """) == ["genomix2", "bass|rosAFE", "|::rosAFE::getSignals", "0|1", "0|"]


def test_aliases_are_commands(world: World) -> None:
    names = "getSignal Gammatone Ratemap CrossCorrelation kill abort_activity connect_service ratemapProcPort"
    test = "if {[info commands ::rosAFE::$name] eq {}} {error $name}"
    script = f"load_both; foreach name {{{names}}} {{{test}}}; show complete"
    assert world.lines(script) == ["complete"]


def test_mistakes_at_connecting_and_loading(world: World) -> None:
    port = harness.free_port()
    lines = world.lines(f"""
        show {{*}}[failure {{genomix::connect 127.0.0.1:{port}}}]
        show [lindex [failure {{genomix::connect a:b:c}}] 1 1]
        set g [genomix::connect $address]
        show {{*}}[failure {{$g load nobody}}]
        show [lindex [failure {{$g load bass -x y}}] 0]
        show [lindex [failure {{$g load bass as genomix}}] 0]
        show [lindex [failure {{$g load bass as {{a b}}}}] 0]
        show [lindex [failure {{$g unload bass}}] 0]
        show [lindex [failure {{bass::Stop}}] 0]
    """)
    what = f"no genomixd at 127.0.0.1:{port} (couldn't open socket: connection refused)"
    assert lines[0] == f"ex ::genom::mwerr detail {{what {{{what}}}}}|GENOM ::genom::mwerr {{what {{{what}}}}}"
    assert lines[1] == "::genom::serialization"
    assert "GENOM ::genom::mwerr {what {nobody is not running: /nobody/connect_port is not registered}}" in lines[2]
    assert 'got "-x"' in lines[3]
    assert '"genomix" is not allowed as a namespace' in lines[4]
    assert "as: expected a letter, followed by letters, digits and _" in lines[5]
    assert 'got "bass"' in lines[6]
    assert "invalid command name" in lines[7]


# --- arguments --------------------------------------------------------------------------------------------------


ARGUMENTS = {  # of GammatoneProc at 8 kHz, and the name and number of channels that they give
    "{name g1 fb_nChannels 3}": "g1|3",
    "{fb_nChannels 3\n    name   g2}": "g2|3",
    "g3": "g3|24",
    "g4 preProc gammatone 80 8000 1 3": "g4|3",
    "-- g5 preProc gammatone 80 8000 1 3": "g5|3",
    "": "gammatone|24",
    "[dict create name g6 fb_nChannels 3]": "g6|3",
    "[subst {name g7 fb_nChannels [expr {1+2}]}]": "g7|3",
    "{name g8 fb_cfHz {100 200 300}}": "g8|3",
    "{name g9 fb_cfHz {2 300 0 100 1 200}}": "g9|3",
    "{name h1 fb_cfHz 440}": "h1|1",
    "{name h2 fb_cfHz {} fb_nChannels 3}": "h2|3",
    "h3 preProc gammatone 80 8000 1 0 {0 100 1 200 2 300}": "h3|3",
    "h4 preProc gammatone 80 8000 1 0 {100 200 300} 4 1.018": "h4|3",
}


def test_argument_forms(world: World) -> None:
    calls = "\n".join(f"rosAFE::GammatoneProc {arguments}" for arguments in ARGUMENTS)
    assert sorted(
        world.lines(f"""
        load_both
        bass::Acquire {{device scene: sampleRate 8000}}
        rosAFE::InputProc
        rosAFE::PreProc {{pp_bRemoveDC true}}
        {calls.replace("8000 1", "3600 1")}
        foreach made [dict values [dict get [rosAFE::getParameters] parameters gammatone]] {{
            show [dict get $made name] [dict get $made fb_nChannels]
        }}
        show [dict get [rosAFE::getParameters] parameters preProc 0 pp_bRemoveDC]
    """)
    ) == sorted([*ARGUMENTS.values(), "1"])


@pytest.mark.parametrize(
    ("command", "reported"),
    [
        (
            "GammatoneProc {name g bogus 1}",
            "GammatoneProc: expected a known parameter, got 'bogus'; GammatoneProc takes",
        ),
        ("GammatoneProc {name g fb_nERBs}", "expected a value for fb_nERBs"),
        ("getDependencies a b c", "expected at most 1 arguments (nameProc), got 3"),
        ("abort_activity -1x", 'expected a switch (-help, -send, -ack, -oneway, --), got "-1x"'),
        ("abort_activity -1", "activity: expected a number in the range of unsigned long, got -1"),
        ("ildPort a b", "expected at most one element, got 2 arguments"),
    ],
)
def test_refused_arguments_are_named(world: World, command: str, reported: str) -> None:
    ex, what, same, background = world.lines(f"""
        load_both
        lassign [failure {{rosAFE::{command}}}] message code
        show [dict get $message ex]
        show [dict get $message detail what]
        show [expr {{$code eq [list GENOM [dict get $message ex] [dict get $message detail]]}}]
        lassign [failure {{rosAFE::{command} &}}] message code
        show [dict get $message detail what]
    """)
    assert ex == "::genom::serialization"
    assert reported in what
    assert same == "1"
    assert reported in background


def test_special_characters_arrive_unchanged_and_are_not_evaluated(world: World) -> None:
    lines = world.lines(r"""
        load_both
        foreach text [list {[exit 3]} "a\nb" "quote\"d" {\\} "t\tab" "\u00e9\u4e2d" {$x} "{" "}" { lead} "\x01"] {
            lassign [failure {bass::Acquire [dict create device $text]}] message
            show [dict get $message ex] [lindex [failure {rosAFE::getDependencies [list nameProc $text]}] 1 1]
        }
        bass::Acquire scene:
        rosAFE::InputProc
        set change {nameProc input nameParam in_doNormalize newValue {[exit 3]}}
        lassign [failure {rosAFE::modifyParameter $change}] message
        show [dict get $message ex] [string match {*\[exit 3\]*} [dict get $message detail what]]
    """)
    assert lines[:-1] == ["::bass::e_device|::rosAFE::e_noSuchProcessor"] * 11
    assert lines[-1] == "::rosAFE::e_badNewValue|1"


# --- results and errors -----------------------------------------------------------------------------------------


def test_results_are_dicts_with_indexed_sequences(world: World) -> None:
    assert world.lines("""
        start_tree
        show [rosAFE::getDependencies gammatone]
        show [rosAFE::Stop] [bass::Stop]
        show [dict keys [rosAFE::getSignals {}]] [dict keys [dict get [rosAFE::getSignal] signals]]
        show [rosAFE::dataObj]
    """) == [
        "dependencies {0 input 1 preProc 2 gammatone}",
        "|",
        "signals|input preProc gammatone ihc ild ratemap crossCorrelation",
        "dataObj {input {} preProc {} gammatone {} ihc {} ild {} ratemap {} crossCorrelation {}}",
    ]


def test_one_representation_is_smaller_than_all_of_them(world: World) -> None:
    """A second of a full tree of 31 channels is 160 MB of text (here an eighth of that); of ILD or ratemap, little."""
    script = """
        load_both
        bass::Acquire scene:
        rosAFE::request ild {fb_nChannels 4}
        rosAFE::request ratemap {fb_nChannels 4}
        while {![dict exists [rosAFE::ildPort ild_0] ildPort lastFrameIndex]
            || [dict get [rosAFE::ildPort ild_0] ildPort lastFrameIndex] < 50000} {after 20}
        foreach name {ild_0 ratemap_0} {show [string length [rosAFE::getRepresentation $name]]}
        show [string length [rosAFE::getSignals]]
    """
    # in less than a minute: the time of getSignals grows as its length, not as the square of that
    *some, everything = map(int, world.lines(script, timeout=harness.PATIENCE))
    assert all(5_000 < length < everything / 100 for length in some), some
    assert everything > 15e6


# --- requests in the background ---------------------------------------------------------------------------------


def test_a_request_lasts_as_long_as_its_activity(world: World) -> None:
    assert world.lines("""
        load_both
        set r [bass::Acquire {device scene:} &]
        show [string match bass::* [$r id]] [$r status] [$r wait 300]
        show [lindex [failure {$r result}] 1 1]
        bass::Stop
        show [$r wait] [$r status] [$r result]
        $r clean
        show [info commands $r]
    """) == ["1|sent|sent", "::genomix::e_notDone", "done|done|", ""]


def test_abort(world: World) -> None:
    assert world.lines("""
        load_both
        set r [bass::Acquire -ack scene:]
        show [$r status]
        $r abort
        show [$r wait 60000]
        $r abort
        show [$r status]
    """) == ["sent", "done", "done"]


def test_only_the_first_status_of_the_end_counts(world: World) -> None:
    assert world.lines("""
        load_both
        set r [rosAFE::getProcessors &]
        show [$r wait]
        set result [$r result]
        show [$r update {status error exception {ex ::genom::late}}]
        show [$r status] [expr {[$r result] eq $result}] [after info]
    """) == ["done", "0", "done|1|"]


def test_callbacks_on_success_and_error_in_the_event_loop(world: World) -> None:
    assert world.lines("""
        load_both
        proc done {args} {
            set request [lindex $args end]
            lappend ::log [lrange $args 0 end-1] [$request status] [catch {$request result} result]
            lappend ::log [dict get $result {*}$::key]
            incr ::count
        }
        proc bgerror {message} {lappend ::log $message; incr ::count}
        set count 0
        set key dependencies
        bass::Acquire scene: &
        rosAFE::InputProc
        rosAFE::getDependencies input & done first {second arg}
        show [info exists log]
        while {$count < 1} {vwait count}
        show $log
        set log {}
        set key ex
        set r [rosAFE::removeProcessor nobody & done]
        while {[$r status] eq "sent"} {after 10}
        show [info exists ::result] $count
        update
        show $log
        set log {}
        rosAFE::getDependencies input & error oops
        while {$count < 3} {vwait count}
        show [string match "*wrong # args*" $log]
        rosAFE::inputProcPort & done
        while {$count < 4} {vwait count}
    """) == [
        "0",
        "{first {second arg}} done 0 {0 input}",
        "0|1",
        "{} error 1 ::rosAFE::e_noSuchProcessor",
        "0",
    ]


def test_requests_in_the_background(world: World) -> None:
    script = """
        start_tree
        foreach command {
            {::rosAFE::getDependencies {nameProc gammatone} &}
            {::rosAFE::preProcPort preProc &}
            {rosAFE::genom_state -s &}
            {rosAFE::getDependencies -s {nameProc input}}
            {rosAFE::getParameters -a}
        } {
            set r [eval $command]
            show [$r wait] [dict keys [$r result]]
        }
        show [rosAFE::removeProcessor -oneway gammatone] [rosAFE::Stop -o]
    """
    keys = ("dependencies", "preProcPort", "genom_state", "dependencies", "parameters")
    assert world.lines(script) == [*(f"done|{key}" for key in keys), "|"]


def test_a_script_that_ends_does_not_hang(world: World) -> None:
    script = "load_both\nbass::Acquire scene: & \nrosAFE::getParameters &\nset r [bass::Stop &]\n"
    assert world.tcl(script).returncode == 0
    # Of the other component: the request Stop is sent, but may still end an activity of bass that begins now.
    done = world.tcl("load_both\nrosAFE::IhcProc {name cells upperDepName none}\n", check=False)
    assert done.returncode == 1
    assert "ex ::rosAFE::e_noUpperDependencie" in done.stderr


def test_a_server_that_restarts(world: World) -> None:
    script = world.graph.home / "gone.tcl"
    script.write_text("""
        package require genomix
        set g [genomix::connect [lindex $argv 0]]
        $g load bass as ears
        set r [ears::Acquire -ack scene:]
        proc say {args} {puts [join $args |]; flush stdout; gets stdin}
        say ready
        say [$r wait 60000] [catch {$r result} message] $message
        say [catch {ears::Stop} message] $message
        say back [ears::Stop] [[ears::genom_state &] wait]
    """)
    with worlds.genomixd(world.graph) as (process, port):
        command = ["tclsh", str(script), f"127.0.0.1:{port}"]
        with subprocess.Popen(
            command, env=world.graph.env, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as client:
            assert client.stdin is not None
            assert client.stdout is not None
            assert client.stdout.readline() == "ready\n"
            process.stop()
            print(file=client.stdin, flush=True)
            lost = client.stdout.readline()
            assert lost.startswith("error|1|ex ::genom::mwerr detail {what {the connection to genomixd at")
            print(file=client.stdin, flush=True)
            assert client.stdout.readline().startswith("1|ex ::genom::mwerr detail {what {no genomixd at 127.0.0.1:")
            with world.graph.start(str(harness.SCRIPTS / "genomixd"), "-v", "-p", str(port)) as again:
                assert worlds.port_of(again) == port
                print(file=client.stdin, flush=True)
                assert client.stdout.readline() == "back||done\n"
                client.stdin.close()
                assert client.wait() == 0


def test_localhost_starts_a_private_server_that_ends_with_the_shell(world: World) -> None:
    first, second = world.lines("""
        set g [genomix::localhost]
        set h [genomix::localhost]
        show $g $h [$g load bass] [bass::Stop] [pid [lindex $genomix::private 0]]
        set r [bass::Acquire scene: &]
        show [$r wait 100]
    """)
    assert first.startswith("genomix1|genomix2|bass||")
    assert second == "sent"
    pid = int(first.rsplit("|", 1)[1])
    harness.wait_for(lambda: not harness.proc(pid).exists(), what=f"end of the private server {pid}")


# --- help -------------------------------------------------------------------------------------------------------


def test_help_has_types_defaults_ranges_and_texts(world: World) -> None:
    script = """
        load_both
        puts [rosAFE::PreProc -h]
        puts [rosAFE::connect_port -help]
        puts [rosAFE::ildPort -h]
        puts [bass::Stop -h]
    """
    reported = world.tcl(script).stdout
    for line in (
        "rosAFE::PreProc: Condition the input",
        "  pp_bRemoveDC (boolean, default 0): Flag to activate the DC-removal high-pass filter",
        "  pp_refSPLdB (double, default 100.0, from -200 to 400): Reference dB SPL value",
        "  pp_middleEarModel (string, default jepsen, one of jepsen, lopezpoveda):",
        "  may fail with ::rosAFE::e_noUpperDependencie",
        "  local (string, no default): Name of this component's input port",
        "rosAFE::ildPort element: Interaural level differences",
        "bass::Stop: Stop the acquisition\n  no parameters",
    ):
        assert line in reported
    assert "invalid command name" in world.lines("load_both\nshow [lindex [failure {rosAFE::noSuch -h}] 0]\n")[0]


# --- messages for users --------------------------------------------------------------------------------------


def test_a_slow_answer_is_reported_on_a_terminal(world: World) -> None:
    """A line that appears and disappears; in a pipe there is none."""
    script = world.graph.home / "long.tcl"
    script.write_text(
        f"""
        package require genomix
        set g [genomix::connect 127.0.0.1:{world.port}]
        $g load rosAFE
        foreach ::genomix::http::progressDelay {{0 100000}} {{
            set port [rosAFE::gammatonePort gammatone]
            puts "got [dict get $port gammatonePort numberOfChannels]"
        }}
        """,
        "utf-8",
    )
    world.tcl("start_tree")
    with Terminal(["tclsh", str(script)], world.graph.env) as terminal:
        shown = terminal.expect("got 4")
        assert re.search(r"rosAFE::gammatonePort: \d+\.\d MB in \d s", shown)
        assert "\r\x1b[Kgot 4" in terminal.sent.replace("\r\n", "\n")  # it is gone
        assert "MB" not in terminal.expect("got 4")
        assert terminal.end() == 0
    done = world.graph.run("tclsh", str(script))
    assert (done.stdout.split(), done.stderr) == (["got", "4"] * 2, "")


def test_background_errors_are_reported_in_one_line(world: World) -> None:
    """Unread errors are reported once, by the background error handler of the script."""
    script = """
        load_both
        set change {nameProc nobody nameParam x newValue 1}
        proc pass {ms} {after $ms {set ::past 1}; vwait ::past}
        rosAFE::modifyParameter $change &
        rosAFE::preProcPort dummyName &
        bass::Stop &
        pass 1500
        # A script that reads the error gets no second report.
        set r [rosAFE::modifyParameter $change &]
        show [$r wait]
        set r [rosAFE::modifyParameter $change &]
        while {[$r status] eq "sent"} {update; after 10}
        show [rosAFE::modifyParameter -ack $change] [catch {rosAFE::modifyParameter $change}]
        show [::genomix::request6 status]
        set r [rosAFE::modifyParameter $change & list]
        set r [rosAFE::modifyParameter $change &]
        $r wait 0
        $r clean
        pass 1500
        proc bgerror {message} {show $message $::errorInfo $::errorCode; set ::told 1}
        rosAFE::modifyParameter $change &
        vwait told
        pass 1000
    """
    done = world.tcl(script)
    ex = "::rosAFE::e_noSuchProcessor"
    message = f"rosAFE::modifyParameter &: {ex}: there is no processor 'nobody'; there are: none"
    assert done.stdout.splitlines() == [
        "error",
        "::genomix::request6|1",
        "error",
        f"{message}|{message}|GENOM {ex} {{}}",
    ]
    missing = "preProcPort has no element 'dummyName'; there are: none"
    assert sorted(done.stderr.splitlines()) == [message, f"rosAFE::preProcPort &: ::genom::no_such_outport: {missing}"]


def test_background_errors_are_reported_at_the_prompt_of_tclsh(world: World) -> None:
    """tclsh handles no events while it waits for a line: errors are reported with the next request, and once."""
    with Terminal(["tclsh"], world.graph.env) as terminal:

        def types(line: str) -> str:
            terminal.press(f"{line}\n")
            return terminal.expect("\n% ")

        terminal.expect("% ")
        types("package require genomix")
        types(f"set g [genomix::connect 127.0.0.1:{world.port}]; $g load rosAFE")
        types("set ::genomix::reportDelay 0")
        types("rosAFE::modifyParameter nobody x 1 &")
        types("$g load rosAFE; after 100")
        reported = types("set looked [rosAFE::removeProcessor nobody2 &]")
        assert "rosAFE::modifyParameter &: ::rosAFE::e_noSuchProcessor: there is no processor 'nobody'" in reported
        assert "error" in types("$looked wait")
        assert "&:" not in types("rosAFE::getProcessors") and "&:" not in types("rosAFE::getProcessors")


def test_a_lost_server_is_reported_once(world: World) -> None:
    with worlds.genomixd(world.graph) as (server, port):
        script = world.graph.home / "lost.tcl"
        script.write_text(f"""
            package require genomix
            set g [genomix::connect 127.0.0.1:{port}]
            $g load bass
            $g load rosAFE
            rosAFE::connect_port Audio bass/Audio
            bass::Acquire -ack scene:
            rosAFE::InputProc -ack {{}}
            rosAFE::PreProc -ack {{}} & list
            puts ready
            flush stdout
            after 30000 {{set past 1}}
            proc bgerror {{message}} {{puts $message; after 1000 {{set ::past 1}}}}
            vwait past
        """)
        with world.graph.start("tclsh", str(script)) as client:
            harness.wait_for(lambda: "ready" in client.out, what=lambda: repr(client))
            server.stop()
            assert client.wait() == 0
            reported = f"::genom::mwerr: the connection to genomixd at 127.0.0.1:{port} is lost"
            assert client.out.splitlines() == ["ready", f"bass::Acquire &: {reported}"]
            assert client.err == ""
