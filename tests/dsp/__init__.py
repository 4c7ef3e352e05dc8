"""Tests of rosafe/dsp."""
