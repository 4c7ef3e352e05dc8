"""Tests of rosafe validate."""
