"""docs/ros2.md: its programs find the source of a scene, started as the page says; its tables have all names."""

from __future__ import annotations

import re
from pathlib import Path

from tests.harness import ROOT, wait_for
from tests.localization.conftest import sphere_model

from .network import Network
from .test_dds import AZIMUTH, scene

__all__ = ["sphere_model"]

PAGE = (ROOT / "docs" / "ros2.md").read_text("utf-8")
PROGRAMS = re.findall("```python\n(.*?)```", PAGE, re.DOTALL)


def test_programs_that_print_sources_and_streams(ros2: Network, tmp_path: Path, sphere_model: Path) -> None:
    """With rclpy and with cyclonedds."""
    ros2.node(f"device:=scene:{scene(tmp_path)}", "localize:=true", f"head:={sphere_model}")
    sources, streams, others = (ros2.python(PROGRAMS[number]) for number in (0, 2, 3))
    for program, count, quietest in ((sources, 8, -60), (others, 8, -60), (streams, 60, -90)):
        wait_for(lambda: len(program.out.splitlines()) > count, what=lambda: str(program))  # noqa: B023
        source, azimuth, *first_sample, level = map(int, program.out.splitlines()[-2].split())
        assert (source, program.err) == (1, "")
        assert abs(azimuth - AZIMUTH) < 8 and quietest < level < 0
    assert first_sample[0] > 16000 // 2


def test_the_program_that_prints_shapes(ros2: Network) -> None:
    ros2.node("device:=scene:", "representations:=[ild, ratemap]")
    program = ros2.python(PROGRAMS[1])
    wait_for(lambda: len(program.out.splitlines()) > 3, what=lambda: f"{program}: {program.out}{program.err}")
    assert re.fullmatch(r"\d+ \(31, \d\) 31 0", program.out.splitlines()[2]) and not program.err


def test_every_topic_service_and_parameter_is_in_the_tables() -> None:
    from_node = re.findall(r'"~/(\w+)"', "".join(p.read_text("utf-8") for p in (ROOT / "rosafe/ros2").glob("*.py")))
    for name in [*from_node, "request", "add_processor", "remove_processor", "get_tree", "save_setup", "acquire"]:
        assert f"`~/{name}`" in PAGE, name
    node = (ROOT / "rosafe/ros2/node.py").read_text("utf-8")
    declared = re.findall(r'^    "(\w+)": \(', node.partition("PARAMETERS")[2].partition("\n}")[0], re.MULTILINE)
    assert len(declared) > 8
    launch = (ROOT / "ros2/rosafe_ros2/launch/rosafe.launch.py").read_text("utf-8")
    for name in declared:
        assert f"`{name}`" in PAGE and f"'{name}': (" in launch, name
    messages = {path.stem for path in (ROOT / "ros2/rosafe_msgs/msg").iterdir()}
    assert messages >= {*re.findall(r"rosafe_msgs/msg/(\w+)", PAGE)}
