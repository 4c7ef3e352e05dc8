"""Run both nodes on a private ROS master for some seconds, and save a figure of seven representations.

It makes the requests of the user guide, records all ports, and prints the number of messages, lost frames and the
direction of the source. No running master or node is used."""

from __future__ import annotations

from rosafe.demo.command import configure, run

__all__ = ["configure", "run"]
