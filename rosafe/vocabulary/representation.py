"""The former place of `rosafe.declarations.representation`, for plugins that were written for 0.2."""

from rosafe.declarations.representation import *  # noqa: F403
