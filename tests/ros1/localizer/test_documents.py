"""docs/directions.md agrees with the code, and its example for ~mute works."""

from __future__ import annotations

import dataclasses
import re
from itertools import groupby

import rospy
from std_msgs.msg import Bool

from rosafe.commands import localize
from rosafe.localization.live import AFTER_SECONDS, MAX_TILT, MAX_WAIT
from rosafe.localization.noise import MARGIN_DB
from rosafe.localization.settings import LocalizerSettings
from rosafe.ros1.localizer.ear_check import QUIET_SECONDS
from tests.harness import PYTHON, ROOT, Graph, wait_for

TEXT = (ROOT / "docs" / "directions.md").read_text("utf-8")


def section(title: str) -> str:
    """Return the text of a section without line breaks."""
    return " ".join(re.split(rf"^##+ {title}$", TEXT, flags=re.MULTILINE)[1].split("\n## ")[0].split())


def test_all_settings_are_documented() -> None:
    for setting in dataclasses.fields(LocalizerSettings):
        if setting.name != "parameters":
            assert f"`~{setting.name}`" in TEXT
            assert f"~{setting.name}" in str(localize.__doc__)


def test_the_limits() -> None:
    turning = section("Turning head")
    assert f"at most {MAX_WAIT:g} s" in turning and f"more than {MAX_TILT:g} degrees" in turning
    assert f"for {AFTER_SECONDS:g} s after" in section("While the robot speaks")
    assert f"{MARGIN_DB:g} dB louder" in section("Steady noise")
    assert f"quiet for {QUIET_SECONDS:g} s" in section("Check the ears")


def test_the_example_for_mute(graph: Graph) -> None:
    (code,) = re.findall(
        r"^```python\n(.*?)^```$", TEXT.split("## While the robot speaks")[1], re.MULTILINE | re.DOTALL
    )
    waiting = "while not mute.get_num_connections(): rospy.sleep(0.01)\n"  # a user's node is connected already
    code = code.replace("mute.publish(True)", waiting + "mute.publish(True)") + "rospy.spin()\n"
    code = code.replace("# speak", 'rospy.wait_for_message("/spoken", Bool)')
    with graph.collect("/localizer/mute", Bool) as messages, graph.start(PYTHON, "-c", code) as speaker:
        wait_for(lambda: any(message.data for message in [*messages]), what=lambda: f"{speaker}")
        spoken = rospy.Publisher("/spoken", Bool, queue_size=1, latch=True)
        spoken.publish(True)
        # a latched message that is published while a subscriber connects may arrive twice
        wait_for(
            lambda: [one for one, _ in groupby(message.data for message in [*messages])] == [True, False],
            what=lambda: f"{speaker}",
        )
