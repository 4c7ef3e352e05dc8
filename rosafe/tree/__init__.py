"""The processor tree: state machine, tokens, windows and parameter changes between blocks. Knows no ROS."""

from rosafe.tree.processor import Listener, Processor, Source, State
from rosafe.tree.tree import Tree

__all__ = ["Listener", "Processor", "Source", "State", "Tree"]
