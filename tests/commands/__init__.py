"""Tests of the command `rosafe`, as a shell runs it."""
