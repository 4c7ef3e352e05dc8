"""The genomix client in Octave: components, requests, values, ports, refusals, and the questions at the prompt."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rosafe.interface import BASS
from tests import harness
from tests.genomix.world import World
from tests.matlab import octave
from tests.terminal import Terminal

pytestmark = pytest.mark.ros

LOADED = """
    client = genomix.client;
    bass = client.load('bass');
    rosAFE = client.load('rosAFE');
"""


def test_components_and_what_is_refused(world: World) -> None:
    told = octave.shown(
        world,
        LOADED
        + """
        text = evalc('disp(rosAFE)');
        show('lines', numel(strfind(text, ': [function_handle]')));
        show('first', ! isempty(strfind(text, '                InputProc: [function_handle]')));
        show('names', fieldnames(rosAFE));
        show('properties', {numel(properties(rosAFE)), isprop(rosAFE, 'ildPort'), isprop(rosAFE, 'none')});
        show('help', evalc("rosAFE.GammatoneProc('-h')"));

        % names: case, aliases, handles
        f = rosAFE.GETPARAMETERS;
        show('handle', {class(f), f().status});
        show('alias', rosAFE.getSignal().status);
        other = client.load('bass', '-i', 'bass');
        path = client.load('~/openrobots/lib/genom/ros/plugins/rosAFE.so');
        show('path', fieldnames(path){1});
        client.rpath('/nowhere');

        % what raises errors, and what does not
        show('no service', message(@() rosAFE.Ratemapproc_()));
        show('no instance', message(@() client.load('rosAFE', '-i')));
        show('wrong instance', message(@() client.load('bass', '-i', 'rosAFE')));
        show('no text', message(@() genomix.client(7)));
        show('address', genomix.client([':' regexp(getenv('GENOMIXD'), '\\d+$', 'match'){1}]).address);
        show('no server', message(@() genomix.client('127.0.0.1:1')));
        r = rosAFE.removeProcessor('nobody');
        show('refused', {r.status, r.exception.ex, isempty(r.result)});
        r = rosAFE.InputProc('-a', 'input', -1);
        show('wrong', {r.status, r.exception.ex, r.exception.detail.what});
        r = rosAFE.PreProc('-a', 'lonely', 'nobody');
        show('acknowledged', {r.status, r.exception.ex});
        r = rosAFE.InputProc(1, 2, 3, 4, 5);
        show('many', r.exception.detail.what);
        r = rosAFE.getDependencies(@sin);
        show('kind', {r.status, r.exception.ex});
        r = rosAFE.GammatoneProc(struct('fb_nERB', 1));
        show('name', r.exception.detail.what);
        p = rosAFE.ildPort('nobody');
        show('port', {class(p), p.status, p.exception.ex, p.exception.detail.what});
        show('cells', {rosAFE.ildPort({'-a', 'b', 'c'}).status, rosAFE.getDependencies({1}).status});
        show('extra', fieldnames(bass.Audio({}, 3)));
        r = rosAFE.GammatoneProc('long', 'preProc', 'gammatone', 80, 8000, 1, 0, rand(1, 1e4));
        show('long', {r.status, r.exception.detail.what});
        r = rosAFE.request('ild', 'fb_nChannels', 16);
        show('pairs', r.exception.detail.what);
        r = bass.Acquire('-a', 'file:/nowhere.wav');
        show('device', {r.status, r.exception.ex});
        r = rosAFE.Stop();
        show('done', {r.status, isempty(r.exception), isstruct(r.result), isempty(fieldnames(r.result))});
        delete(other);
        show('deleted', message(@() other.Stop()));
        delete(client);
        """,
    )
    services, ports = (world.http.get("/describe/rosAFE")[kind] for kind in ("services", "ports"))
    assert told["names"] == [*services, *ports]
    assert told["properties"] == [len(told["names"]), True, False]
    assert told["lines"] == len(told["names"]) and told["first"]
    assert "unsigned long fb_nChannels: Number of channels; 0: as many as fb_nERBs gives (0)" in told["help"]
    assert told["handle"] == ["function_handle", "done"]
    assert told["alias"] == "done" and told["path"] == "InputProc"
    assert told["no service"].startswith(
        "genomix:component rosAFE has no service or port 'Ratemapproc_'; it has: Input"
    )
    assert "may be only: '-i', 'instance'" in told["no instance"]
    assert "/rosAFE is a rosAFE, and no bass" in told["wrong instance"]
    assert told["no text"].startswith("genomix:connection the address of genomixd is a text")
    assert told["address"] == f"127.0.0.1:{world.port}"
    assert told["no server"].startswith("genomix:connection no answer from genomixd at 127.0.0.1:1 (")
    assert "genomixd &" in told["no server"]
    assert told["refused"] == ["error", "::rosAFE::e_noSuchProcessor", True]
    assert told["wrong"][:2] == ["error", "::genom::serialization"] and "nFramesPerBlock" in told["wrong"][2]
    assert told["acknowledged"] == ["error", "::rosAFE::e_noUpperDependencie"]
    assert told["many"].startswith("5 arguments are too many; InputProc takes name (string)")
    assert told["kind"] == ["error", "::genom::serialization"]
    assert told["name"].startswith("unknown parameter 'fb_nERB'")
    assert told["port"][:3] == ["genomix.request", "error", "::genom::no_such_outport"]
    assert told["port"][3] == "ildPort has no element 'nobody'; there are: none"
    assert told["cells"] == ["error", "error"]
    assert told["extra"] == ["Audio"]
    assert told["long"][0] == "error" and "the arguments are too long" in told["long"][1]
    assert told["pairs"].endswith("after representation come the parameters in one object, not 'fb_nChannels'")
    assert told["device"] == ["error", "::bass::e_device"]
    assert told["done"] == ["done", True, True, True]
    assert "was deleted" in told["deleted"]


def test_values(world: World) -> None:
    """Arguments in all their spellings arrive, and results have the classes and shapes that scripts expect."""
    told = octave.shown(
        world,
        LOADED
        + """
        acquire = bass.Acquire('-a', 'scene:');
        rosAFE.connect_port('Audio', 'bass/Audio');
        rosAFE.InputProc('-a', 'input', 12000, 0.5, 0.5);
        rosAFE.PreProc('-a', 'preProc', 'input', 1, 20, false, 0.97, logical(1));
        rosAFE.GammatoneProc('-a', 'scalar', 'preProc', 'gammatone', 80, 8000, 1, 5, 0, 4, 1.018);
        rosAFE.GammatoneProc('-a', 'empty', 'preProc', 'gammatone', 80, 8000, 1, 5, {}, 4, 1.018);
        rosAFE.GammatoneProc('-a', 'cells', 'preProc', 'gammatone', 80, 8000, 1, 0, {100, 200.25, 1/3*1000});
        rosAFE.GammatoneProc('-a', 'matrix', 'preProc', 'gammatone', 80, 8000, 1, 0, [100; 200.25; 1000/3]);
        rosAFE.GammatoneProc('-a', struct('name', 'named', 'fb_nChannels', int32(3), 'fb_bwERBs', single(1.5)));
        r = rosAFE.IhcProc('-a', 'ä"\\ ihc', 'scalar');
        show('odd', r.status);
        g = rosAFE.getParameters();
        p = g.result.parameters;
        show('shapes', {size(p.gammatone), size(p.gammatone{3}.fb_cfHz), size(p.ild), class(p.ild)});
        show('classes', {class(p.gammatone), class(p.gammatone{3}.fb_cfHz), class(p.gammatone{3}.fb_type)});
        show('equal', [p.preProc{1}.pp_bRemoveDC == 1, p.preProc{1}.pp_bPreEmphasis == 0, ...
            p.preProc{1}.pp_bNormalizeRMS == true, p.preProc{1}.pp_coefPreEmphasis == 0.97, ...
            p.gammatone{1}.fb_bwERBs == 1.018, p.gammatone{5}.fb_bwERBs == 1.5, p.gammatone{5}.fb_nChannels == 3]);
        show('cfHz', isequal(cell2mat(p.gammatone{3}.fb_cfHz), [100 200.25 1000/3]));
        show('both', isequal(p.gammatone{3}.fb_cfHz, p.gammatone{4}.fb_cfHz));
        show('numbers', cellfun(@(one) numel(one.fb_cfHz), p.gammatone));
        show('empty', {size(cell2mat(p.ild)), isempty(p.ild)});
        m = rosAFE.getParameters('-m');
        show('-m', {class(m.result.parameters.gammatone{3}.fb_cfHz), size(m.result.parameters.gammatone{3}.fb_cfHz)});
        d = rosAFE.getDependencies('scalar');
        show('names', {size(d.result.dependencies), d.result.dependencies{:}});
        show('last', strcmp(d.result.dependencies(end - 1), 'preProc'));
        show('no result', isempty(acquire.result));
        s = rosAFE.genom_state();
        show('state', {class(s.genom_state.task), class(s.genom_state.task{1}.name)});

        % requests that go on, and end
        show('sent', acquire.status);
        show('waited', acquire.wait(0.1));
        shown = evalc('disp(acquire)');
        acquire.abort();
        show('aborted', {acquire.wait(60), isempty(acquire.exception), acquire.status, shown});
        again = bass.Acquire('-a', 'scene:');
        bass.Stop();
        show('stopped', again.wait(60));
        f = rosAFE.getParameters('-a');
        show('function', {f.wait(60), fieldnames(f.result)});
        """,
    )
    assert told["odd"] == "error"  # no name of a topic
    assert told["shapes"] == [[1, 5], [1, 3], [1, 0], "cell"]
    assert told["classes"] == ["cell", "cell", "char"]
    assert all(told["equal"]) and told["cfHz"] and told["both"]
    assert told["numbers"] == [5, 5, 3, 3, 3]
    assert told["empty"][1] and 0 in told["empty"][0]
    assert told["-m"] == ["double", [3, 1]]
    assert told["names"] == [[1, 3], "input", "preProc", "scalar"] and told["last"]
    assert told["no result"]
    assert told["state"] == ["cell", "char"]
    assert told["sent"] == told["waited"] == "sent"
    assert told["aborted"][:3] == ["done", True, "done"]
    shown = "  request with properties:\n\n       status: 'sent'\n       result: []\n    exception: []\n"
    assert told["aborted"][3] == shown
    assert told["stopped"] == "done"
    assert told["function"] == ["done", ["parameters"]]


PORTS = {
    "inputProcPort": "input_0",
    "preProcPort": "time_0",
    "gammatonePort": "filterbank_0",
    "ihcPort": "innerhaircell_0",
    "ildPort": "ild_0",
    "ratemapPort": "ratemap_0",
    "crossCorrelationPort": "crosscorrelation_0",
}


def test_numbers_are_those_of_the_ports(world: World, tmp_path: Path) -> None:
    """Every sample of every port, as a matrix and in cells: exactly what the port holds."""
    octave.run(
        world,
        LOADED
        + f"""
        acquire = bass.Acquire('-a', 'scene:', 16000);
        p = struct('fb_nChannels', 3, 'fb_highFreqHz', 4000, 'nFramesPerBlock', 1600, 'bufferSize_s_port', 0.3);
        for request = {{'ild', 'ratemap', 'crosscorrelation'}}
            tree = rosAFE.request(request{{1}}, p);
            assert(tree.status, 'done')
        end
        pause(0.5);
        bass.Stop();
        ports = {{{", ".join(f"'{port}', '{element}'" for port, element in PORTS.items())}}};
        ends = [1 2];
        before = [];
        while any(ends ~= ends(1)) || ! isequal(ends, before) % until the last block has come through
            pause(0.3);
            before = ends;
            for k = 1:2:numel(ports)
                one = rosAFE.(ports{{k}})('-m', ports{{k + 1}});
                ends((k + 1) / 2) = one.(ports{{k}}).lastFrameIndex;
            end
        end
        for k = 1:2:numel(ports)
            one = rosAFE.(ports{{k}})('-m', ports{{k + 1}}).(ports{{k}});
            cells = rosAFE.(ports{{k}})(ports{{k + 1}}).(ports{{k}});
            out = fopen(['{tmp_path}/' ports{{k}}], 'w');
            fwrite(out, one.left, 'double');
            if isfield(one, 'right')
                fwrite(out, one.right, 'double');
            end
            fclose(out);
            if isfield(cells.left, 'data')
                assert(cell2mat(cells.left.data)', one.left)
                assert(cell2mat(cells.right.data)', one.right)
            elseif isfield(cells.left, 'dataN')
                [left, right] = adaptTFS(one.framesOnPort, 3, cells.left, ! isempty(one.right), cells.right);
                assert(left, one.left)
                assert(isempty(one.right) || isequal(right, one.right))
            else
                for lag = 1:one.numberOfLags
                    for channel = 1:3
                        assert(cell2mat(cells.left.dataNxN{{lag}}.dataN{{channel}}.data)', one.left(:, channel, lag))
                    end
                end
            end
        end
        """,
    )
    for port, element in PORTS.items():
        held = world.http.call(f"rosAFE/{port}/{element}")[port]
        wanted = np.concatenate([_flat(held[ear]) for ear in ("left", "right") if ear in held])
        assert np.std(wanted) > 0
        np.testing.assert_array_equal(np.fromfile(tmp_path / port), wanted, err_msg=port)


def _flat(signal: dict[str, Any]) -> np.ndarray:
    """A signal of the JSON answer, frame after frame, channel after channel, lag after lag."""
    (inner,) = signal.values()
    return (
        np.concatenate([np.empty(0), *map(_flat, inner)]) if inner and isinstance(inner[0], dict) else np.array(inner)
    )


def test_questions_at_the_prompt(world: World) -> None:
    """A person who calls a service without arguments is asked for them; a function in between, or a pipe, is not."""
    octave.needed()
    command = [*octave.COMMAND, "--no-line-editing"]
    with Terminal(command, {**world.graph.env, **octave.environment(world)}) as terminal:
        terminal.expect("> ")
        terminal.press("client = genomix.client; bass = client.load('bass'); rosAFE = client.load('rosAFE');\r")
        terminal.press("r = bass.Acquire('-a');\r")
        terminal.expect(f"string device: {BASS.service('Acquire').parameter('device').doc} (hw:1,0) > ")
        terminal.press("'scene:'\r")  # as people are used to; the quotes are not part of it
        terminal.expect("unsigned long sampleRate: ")
        terminal.expect("(44100) > ")
        terminal.press("22050\r")
        for name in ("nFramesPerChunk", "nChunksOnPort"):
            terminal.expect(f"{name}: ")
            terminal.expect(") > ")
            terminal.press("\r")
        terminal.press("r\r")
        terminal.expect("r =")
        terminal.expect("  request with properties:")
        for line in ("       status: 'sent'", "       result: []", "    exception: []"):
            terminal.expect(line)
        harness.wait_for(lambda: world.http.call("bass/Audio")["Audio"]["sampleRate"] == 22050, what="the given rate")
        terminal.press("d = rosAFE.getDependencies('ild'); disp(['then ' d.status])\r")
        terminal.expect("then error")
        terminal.press("f = @() 1; function r = within(c), r = c.getDependencies(); end\r")
        terminal.press("d = within(rosAFE); disp(['within ' d.status])\r")
        terminal.expect("within error")
        terminal.press("p = rosAFE.ildPort()\r")
        terminal.expect("string element: name of the processor > ")
        terminal.press('"no\'body"\r')
        for line in ("status: 'error'", "result: []", "exception: [1x1 struct] ::genom::no_such_outport: "):
            terminal.expect(line)
        terminal.expect('ildPort has no element "no\'body"; there are: none')
        terminal.press("exit\r")
        terminal.end()
