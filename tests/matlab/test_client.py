"""The genomix client in Octave: components, requests, values, ports, errors, and questions at the prompt."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rosafe.interface import BASS
from tests import harness
from tests.matlab import octave
from tests.terminal import Terminal
from tests.web.genomix.world import World

pytestmark = pytest.mark.ros

LOADED = """
    client = genomix.client;
    bass = client.load('bass');
    rosAFE = client.load('rosAFE');
"""


def test_components_and_errors(world: World) -> None:
    results = octave.run_and_parse(
        world,
        LOADED
        + """
        text = evalc('disp(rosAFE)');
        assert(numel(strfind(text, ': [function_handle]')) == numel(fieldnames(rosAFE)));
        assert(! isempty(strfind(text, '                InputProc: [function_handle]')));
        show('names', fieldnames(rosAFE));
        assert(numel(properties(rosAFE)) == numel(fieldnames(rosAFE)));
        assert(isprop(rosAFE, 'ildPort') && ! isprop(rosAFE, 'none'));
        show('help', evalc("rosAFE.GammatoneProc('-h')"));

        % names: case, aliases, handles
        f = rosAFE.GETPARAMETERS;
        assert({class(f), f().status, rosAFE.getSignal().status}, {'function_handle', 'done', 'done'});
        other = client.load('bass', '-i', 'bass');
        path = client.load('~/openrobots/lib/genom/ros/plugins/rosAFE.so');
        assert(fieldnames(path){1}, 'InputProc');
        client.rpath('/nowhere');

        % local errors, and errors in requests
        show('no service', message(@() rosAFE.Ratemapproc_()));
        show('no instance', message(@() client.load('rosAFE', '-i')));
        show('wrong instance', message(@() client.load('bass', '-i', 'rosAFE')));
        show('no text', message(@() genomix.client(7)));
        show('address', genomix.client([':' regexp(getenv('GENOMIXD'), '\\d+$', 'match'){1}]).address);
        show('no server', message(@() genomix.client('127.0.0.1:1')));
        r = rosAFE.removeProcessor('missing');
        assert({r.status, r.exception.ex, isempty(r.result)}, {'error', '::rosAFE::e_noSuchProcessor', true});
        r = rosAFE.PreProc('-a', 'lonely', 'missing');
        assert({r.status, r.exception.ex}, {'error', '::rosAFE::e_noUpperDependencie'});
        r = rosAFE.InputProc(1, 2, 3, 4, 5);
        show('many', r.exception.detail.what);
        r = rosAFE.getDependencies(@sin);
        assert({r.status, r.exception.ex}, {'error', '::genom::serialization'});
        p = rosAFE.ildPort('missing');
        assert({class(p), p.status, p.exception.ex}, {'genomix.request', 'error', '::genom::no_such_outport'});
        assert(p.exception.detail.what, 'ildPort has no element ''missing''; there are: none');
        assert({rosAFE.ildPort({'-a', 'b', 'c'}).status, rosAFE.getDependencies({1}).status}, {'error', 'error'});
        assert(fieldnames(bass.Audio({}, 3)), {'Audio'});
        r = rosAFE.GammatoneProc('long', 'preProc', 'gammatone', 80, 8000, 1, 0, rand(1, 1e4));
        show('long', {r.status, r.exception.detail.what});
        r = rosAFE.request('ild', 'fb_nChannels', 16);
        show('pairs', r.exception.detail.what);
        r = bass.Acquire('-a', 'file:/nowhere.wav');
        assert({r.status, r.exception.ex}, {'error', '::bass::e_device'});
        r = rosAFE.Stop();
        assert(strcmp(r.status, 'done') && isempty(r.exception) && isempty(fieldnames(r.result)));
        delete(other);
        show('deleted', message(@() other.Stop()));
        delete(client);
        """,
    )
    services, ports = (world.http.get("/describe/rosAFE")[kind] for kind in ("services", "ports"))
    assert results["names"] == [*services, *ports]
    assert "unsigned long fb_nChannels: Number of channels; 0: as many as fb_nERBs gives (0)" in results["help"]
    assert results["no service"].startswith("genomix:component rosAFE: expected a service or port (Input")
    assert results["no service"].endswith("), got 'Ratemapproc_'")
    assert "expected '-i', 'instance'" in results["no instance"]
    assert "/rosAFE: expected the component bass, got rosAFE" in results["wrong instance"]
    assert results["no text"].startswith("genomix:connection address: expected a text")
    assert results["address"] == f"127.0.0.1:{world.port}"
    assert results["no server"].startswith("genomix:connection no answer from genomixd at 127.0.0.1:1 (")
    assert "genomixd &" in results["no server"]
    assert results["many"].startswith("InputProc: expected at most 4 arguments, got 5; InputProc takes name (string)")
    assert results["long"][0] == "error" and "expected arguments of at most 80000 characters" in results["long"][1]
    assert results["pairs"].endswith("expected the parameters in one object after representation, got 'fb_nChannels'")
    assert "was deleted" in results["deleted"]


def test_values(world: World) -> None:
    """All forms of arguments are accepted, and results have the classes and shapes that scripts expect."""
    octave.run(
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
        assert(r.status, 'error'); % not a valid name of a topic
        g = rosAFE.getParameters();
        p = g.result.parameters;
        assert({size(p.gammatone), size(p.gammatone{3}.fb_cfHz), size(p.ild)}, {[1 5], [1 3], [1 0]});
        kinds = cellfun(@class, {p.ild, p.gammatone, p.gammatone{3}.fb_cfHz, p.gammatone{3}.fb_type}, ...
            'UniformOutput', false);
        assert(kinds, {'cell', 'cell', 'cell', 'char'});
        assert([p.preProc{1}.pp_bRemoveDC == 1, p.preProc{1}.pp_bPreEmphasis == 0, ...
            p.preProc{1}.pp_bNormalizeRMS == true, p.preProc{1}.pp_coefPreEmphasis == 0.97, ...
            p.gammatone{1}.fb_bwERBs == 1.018, p.gammatone{5}.fb_bwERBs == 1.5, p.gammatone{5}.fb_nChannels == 3]);
        assert(cell2mat(p.gammatone{3}.fb_cfHz), [100 200.25 1000/3]);
        assert(p.gammatone{3}.fb_cfHz, p.gammatone{4}.fb_cfHz);
        assert(cellfun(@(one) numel(one.fb_cfHz), p.gammatone), [5 5 3 3 3]);
        assert(isempty(cell2mat(p.ild)));
        m = rosAFE.getParameters('-m').result.parameters.gammatone{3}.fb_cfHz;
        assert({class(m), size(m)}, {'double', [3 1]});
        d = rosAFE.getDependencies('scalar');
        assert(d.result.dependencies, {'input', 'preProc', 'scalar'});
        assert(isempty(acquire.result));
        s = rosAFE.genom_state();
        assert({class(s.genom_state.task), class(s.genom_state.task{1}.name)}, {'cell', 'char'});

        % requests that are running, and that end
        assert({acquire.status, acquire.wait(0.1)}, {'sent', 'sent'});
        assert(evalc('disp(acquire)'), sprintf( ...
            '  request with properties:\\n\\n       status: ''sent''\\n       result: []\\n    exception: []\\n'));
        acquire.abort();
        assert({acquire.wait(60), acquire.exception, acquire.status}, {'done', [], 'done'});
        again = bass.Acquire('-a', 'scene:');
        bass.Stop();
        assert(again.wait(60), 'done');
        f = rosAFE.getParameters('-a');
        assert({f.wait(60), fieldnames(f.result)}, {'done', {'parameters'}});
        """,
    )


PORTS = {
    "inputProcPort": "input_0",
    "preProcPort": "time_0",
    "gammatonePort": "filterbank_0",
    "ihcPort": "innerhaircell_0",
    "ildPort": "ild_0",
    "ratemapPort": "ratemap_0",
    "crossCorrelationPort": "crosscorrelation_0",
}


def test_port_data_are_exact(world: World, tmp_path: Path) -> None:
    """All samples of all ports, as matrices and in cells, are equal to those of the port."""
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
        while any(ends ~= ends(1)) || ! isequal(ends, before) % until all processors have finished
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
        expected = np.concatenate([_flat(held[ear]) for ear in ("left", "right") if ear in held])
        assert np.std(expected) > 0
        np.testing.assert_array_equal(np.fromfile(tmp_path / port), expected, err_msg=port)


def _flat(signal: dict[str, Any]) -> np.ndarray:
    """Return a signal of the JSON answer as a vector, ordered by lag, channel and frame."""
    (inner,) = signal.values()
    return (
        np.concatenate([np.empty(0), *map(_flat, inner)]) if inner and isinstance(inner[0], dict) else np.array(inner)
    )


def test_questions_at_the_prompt(world: World) -> None:
    """A service that is called at the prompt without arguments asks for them; one called in a function does not."""
    octave.require_program()
    command = [*octave.COMMAND, "--no-line-editing"]
    with Terminal(command, {**world.graph.env, **octave.environment(world)}) as terminal:
        terminal.expect("> ")
        terminal.press("client = genomix.client; bass = client.load('bass'); rosAFE = client.load('rosAFE');\r")
        terminal.press("r = bass.Acquire('-a');\r")
        terminal.expect(f"string device: {BASS.service('Acquire').parameter('device').doc} (hw:1,0) > ")
        terminal.press("'scene:'\r")  # the quotes are removed
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
