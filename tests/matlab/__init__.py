"""Tests of the MATLAB client, in Octave."""
