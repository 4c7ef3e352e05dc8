"""Names in the header Host: which ones are accepted as names of this machine."""

from __future__ import annotations

import socket

import pytest

from rosafe.web.server.access import HttpRefusal, check_host, host_name, own_names


@pytest.mark.parametrize(
    ("header", "name"),
    [
        ("robot", "robot"),
        ("Robot.Lab", "robot.lab"),
        ("robot.lab:8080", "robot.lab"),
        ("ROBOT.lab.:8080", "robot.lab"),
        ("robot_2-b.local.", "robot_2-b.local"),
        (" robot\t", "robot"),
        ("127.0.0.1:8080", "127.0.0.1"),
        ("[::1]:8080", "::1"),
        ("[::1]", "::1"),
        ("robot:", "robot"),
        *((text, "") for text in ("", ":8080", ".", "robot..", "a b", "robot:x", "robot:80:80", "::1", "[robot]")),
        *((text, "") for text in ("http://robot", "robot/x", "me@robot", "röbot", "robot:٣", "robot,localhost", "*")),
    ],
)
def test_host_names(header: str, name: str) -> None:
    assert host_name(header) == name


@pytest.mark.parametrize("header", ["robot", "ROBOT.:1", "localhost", "LocalHost:8080", "10.0.0.1:99", "[fe80::1]:80"])
def test_names_that_are_accepted(header: str) -> None:
    check_host({"Host": header}, {"robot"}, "")


@pytest.mark.parametrize("header", ["", "robot.evil.example", "localhost.evil.example", "127.0.0.1.evil.example", "r"])
def test_names_that_are_refused(header: str) -> None:
    with pytest.raises(HttpRefusal, match=r"expected a name of this server, got '.*'; do that$") as refusal:
        check_host({"Host": header} if header else {}, {"robot"}, "do that")
    assert refusal.value.status == 403


def test_names_of_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "Robot.Lab.example")
    monkeypatch.setattr(socket, "getfqdn", lambda: "robot.lab.example.")
    assert own_names({}) == {"robot.lab.example", "robot", "robot.local"}
    assert own_names({"ROS_HOSTNAME": "Ears.example"}) == {
        "robot.lab.example", "robot", "robot.local", "ears.example"
    }  # fmt: skip
