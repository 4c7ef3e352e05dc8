"""The original user's guide, typed word for word, and the ways in which published scripts use genomix."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import harness
from tests.web.genomix import world as worlds
from tests.web.genomix.world import World

pytestmark = pytest.mark.ros

SHELLS = ("tclsh", "eltclsh")


@pytest.fixture
def fresh_world(tmp_path: Path) -> Iterator[World]:
    """Components that were not used yet."""
    with worlds.world(tmp_path) as world:
        yield world


def guide_commands() -> list[str]:
    """The guide's commands for eltclsh, with a sound device that exists everywhere."""
    text = harness.shared("spec", "original-user-guide.txt").read_text("utf-8")
    commands = re.findall(r"^.*eltclsh[ ]*>[ ]*(.*?)[ ]*$", text, re.MULTILINE)
    assert len(commands) == 18
    return [command.replace("hw:1,0", "scene:") for command in commands]


def run_shell(world: World, shell: str, script: str) -> subprocess.CompletedProcess[str]:
    path = world.graph.home / "session.tcl"
    path.write_text(script, "utf-8")
    # `genomix::connect` without an address, as in the guide, but not on the default port.
    return world.graph.run(shell, str(path), GENOMIXD=f"127.0.0.1:{world.port}")


def test_the_guide_runs_as_a_script(fresh_world: World) -> None:
    done = run_shell(fresh_world, "tclsh", "\n".join(guide_commands()) + "\n")
    assert (done.stdout, done.stderr) == ("", "")
    parameters = fresh_world.http.call("rosAFE/getParameters")["parameters"]
    # The script's last requests, such as removeProcessor, are still in progress when it ends.
    harness.wait_for(lambda: not fresh_world.http.call("rosAFE/getParameters")["parameters"]["preProc"])
    assert [p["name"] for p in parameters["input"]] == ["input"]


def test_each_command_of_the_guide_has_its_documented_result(fresh_world: World) -> None:
    commands = guide_commands()
    script = ["set results {}", "proc note {result} {lappend ::results $result}"]
    for command in commands[:-2]:
        # Typed at a prompt: the result of each line, which for a line with & is the request.
        script.append(f"note [uplevel #0 {{{command}}}]")
    script.append(
        """
        foreach name {modify parameters dependencies signals} request [lrange $results end-3 end] {
            puts [list $name [$request wait 60000] [catch {$request result} result] $result]
        }
        set running [concat [lrange $results 4 6] [lrange $results 9 11]]
        puts [list activities {*}[lmap request $running {$request status}]]
        """
    )
    for command in commands[-2:]:
        script.append(f"set last [uplevel #0 {{{command}}}]")
        script.append("puts [list last [$last wait 60000] [catch {$last result} result] $result]")
    script.append("puts [list plain [lrange $results 0 3] [lrange $results 7 8]]")
    lines = run_shell(fresh_world, "eltclsh", "\n".join(script)).stdout.splitlines()
    assert lines[0] == (
        "modify error 1 {ex ::rosAFE::e_noSuchParameter what "
        "{processors of kind input have no 'pp_bRemoveDC'; they have: in_doNormalize, in_normalizeValue}}"
    )
    for part in (
        "pp_refSPLdB 100.0",
        "pp_middleEarModel jepsen",
        "fb_nChannels 31",
        "ihc_method dau",
        "ild_wname hann ild_wSizeSec 0.02 ild_hSizeSec 0.01",
        "rm_scaling power rm_decaySec 0.008",
        "name crosscorrelation cc_wname hann cc_wSizeSec 0.02 cc_hSizeSec 0.01 cc_maxDelaySec 0.0011",
    ):
        assert part in lines[1]
    assert lines[1].startswith("parameters done 0 {parameters {input {0 {name input")
    assert lines[2] == "dependencies done 0 {dependencies {0 input 1 preProc 2 gammatone 3 ihc 4 ratemap}}"
    assert lines[3].startswith("signals done 0 {signals {input {0 {sampleRate 44100 ")
    assert lines[4] == "activities sent sent sent sent sent sent"
    assert lines[5] == "last done 0 {}"
    assert lines[6].startswith(
        "last error 1 {ex ::genom::no_such_outport detail {what {preProcPort has no element 'dummyName'"
    )
    assert lines[7] == "plain {1.8 genomix1 rosAFE {}} {{} {}}"


PATTERNS = {
    "1: literal handle, plugin path": """
        genomix::connect $address
        genomix1 load /home/robot/openrobots/lib/genom/ros/plugins/bass.so
        after 10
        show [bass::Stop]
    """,
    "2: rpath": """
        genomix::connect $address
        genomix1 rpath ~/openrobots/devel/lib/genom/ros/plugins/
        genomix1 load bass
        show [bass::Stop]
    """,
    "3 4: positional and braced, absolute remote": """
        ::genomix::connect $address
        genomix1 load rosAFE
        ::rosAFE::connect_port {local Audio remote /bass/Audio}
        show [::rosAFE::connect_port Audio /bass/Audio]
    """,
    "5: private server, result unused": """
        genomix::localhost
        genomix1 load rosAFE
        show [rosAFE::connect_port "Audio" "bass/Audio"]
    """,
    "6: host and port, instance and alias, spaces in braces": """
        set g [genomix::connect $address]
        $g rpath /tmp
        $g load bass -i bass as bass
        $g load rosAFE -i rosAFE as rosAFE
        show [rosAFE::connect_port { local Audio remote bass/Audio }]
    """,
    "7: a loop that reads a port": """
        set handle [genomix::connect $address]
        $handle load bass -i bass
        bass::Acquire {device scene:}
        for {set i 0} {$i < 5} {incr i} {
            set m [bass::Audio]
            set rate [dict get [dict get $m Audio] sampleRate]
        }
        show [expr {$rate == 44100 ? "" : $rate}]
    """,
    "8: callback that takes the result": """
        set g [genomix::connect $address]
        $g load bass
        proc acquired {mod rqid} {
            catch {$rqid result} m
            set ::told [list $mod [$rqid status] $m]
        }
        bass::Acquire {device none} & acquired bass
        vwait told
        show [expr {[lrange $told 0 1] eq {bass error} ? [string range [dict get [lindex $told 2] ex] 17 end] : $told}]
    """,
    "9: request name dropped": """
        set g [genomix::connect $address]
        $g load bass
        bass::Acquire scene: &
        bass::Stop &
        show [bass::Stop]
    """,
    "10: negative positions": """
        set g [genomix::connect $address]
        $g load rosAFE
        catch {rosAFE::PreProc -- p input 0 -100} m
        show [expr {[dict get $m ex] eq "::rosAFE::e_noUpperDependencie" ? "" : $m}]
    """,
    "11 13: computed dicts, saved output as input": """
        set g [genomix::connect $address]
        $g load bass
        bass::Acquire [dict create device scene: sampleRate 22050]
        set saved [dict filter [dict get [bass::Audio] Audio] key sampleRate nFramesPerChunk]
        show [bass::Acquire [dict create device scene: {*}$saved]]
    """,
    "12: lassign on a structure": """
        set g [genomix::connect $address]
        $g load bass
        bass::Acquire scene:
        lassign [dict get [bass::Audio] Audio] k1 rate k2 chunks
        show [expr {"$k1 $rate $k2 $chunks" eq "sampleRate 44100 nChunksOnPort 20" ? "" : "$k1 $rate"}]
    """,
    "15: kill one after another": """
        set g [genomix::connect $address]
        $g load left
        show [left::kill]
    """,
    "16 19: -s with &, status, result's exception": """
        set s [catch {set handle [genomix::connect $address]} result]
        $handle load bass
        set request [::bass::Acquire -s {device none} &]
        while {[$request status] eq "sent"} {update; after 5}
        catch {$request result} e
        show [expr {[dict get $e ex] eq "::bass::e_device" ? "" : $e}]
    """,
    "17: wait for the component, then load": """
        set handle [genomix::connect $address]
        while 1 {
            if {![catch {exec rostopic list | grep -c bass}]} {
                $handle load bass -i bass
                break
            }
            after 500
        }
        show [bass::Stop]
    """,
    "18: eval and catch": """
        set g [genomix::connect $address]
        $g load rosAFE
        lassign {rosAFE Audio bass Audio} c1 p1 c2 p2
        set status [catch {eval "$c1::connect_port $p1 $c2/$p2"} result]
        set status [catch {eval "${c1}::connect_port $p1 $c2/$p2"} result]
        show [expr {$status == "0" ? $result : "$status $result"}]
    """,
    "20: -h tells whether a service exists": """
        set g [genomix::connect $address]
        $g load rosAFE
        show [expr {[catch {rosAFE::getSignals -h}] || ![catch {rosAFE::nothing -h}] ? "wrong" : ""}]
    """,
    "21: -ack with subst": """
        set g [genomix::connect $address]
        $g load bass
        set rate 16000
        set r [bass::Acquire -ack [subst {device scene: sampleRate $rate}]]
        show [expr {[dict get [bass::Audio] Audio sampleRate] == $rate ? "" : "not acknowledged"}]
    """,
    "23: functions and ports in the background": """
        set g [genomix::connect $address]
        $g load rosAFE
        set all [list [::rosAFE::getParameters &] [::rosAFE::getDependencies {nameProc ratemap} &] \\
            [::rosAFE::getSignals {} &] [::rosAFE::removeProcessor {name preProc} &] \\
            [::rosAFE::preProcPort dummyName &]]
        show [expr {[lmap r $all {$r wait 60000}] eq {done error done error error} ? "" : [lmap r $all {$r status}]}]
    """,
    "24b: continued lines and comments": """
        set g [genomix::connect $address]
        $g load bass; $g load rosAFE ;#comment
        ::bass::Acquire {device scene: sampleRate 44100 \\
            nFramesPerChunk 2205 nChunksOnPort 20} &
        show [::bass::Stop]
        exit
    """,
}


@pytest.mark.parametrize(
    ("pattern", "shell"),
    [
        pytest.param(pattern, shell, marks=() if (number + position) % 2 else pytest.mark.exploration)
        for number, pattern in enumerate(PATTERNS)
        for position, shell in enumerate(SHELLS)
    ],
)
def test_usage_patterns_of_published_scripts(world: World, pattern: str, shell: str) -> None:
    """Each shows an empty line on success."""
    if "left" in PATTERNS[pattern]:
        with world.graph.node("bass-ros", "-i", "left"):
            assert world.lines(PATTERNS[pattern], shell=shell) == [""]
    else:
        assert world.lines(PATTERNS[pattern], shell=shell) == [""]


@pytest.mark.parametrize("shell", SHELLS)
def test_pattern_24_a_shell_script_that_execs_a_tcl_shell(world: World, shell: str) -> None:
    """OPT, LER: stop scripts are separate executables."""
    script = world.graph.home / "stop.tcl"
    script.write_text(
        f'#!/bin/sh\n# the next line restarts using {shell} \\\nexec {shell} "$0" ${{1+"$@"}}\n'
        "package require genomix\nset g [genomix::connect [lindex $argv 0]]\n$g rpath /tmp\n$g load bass\n"
        "bass::Stop\nputs stopped\n"
    )
    script.chmod(0o755)
    assert world.graph.run(str(script), f"127.0.0.1:{world.port}").stdout == "stopped\n"
