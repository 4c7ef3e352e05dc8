"""The former place of `rosafe.declarations.parameter`, for plugins that were written for 0.2."""

from rosafe.declarations.parameter import *  # noqa: F403
