"""Tests of the streaming numerics (rosafe/dsp)."""
