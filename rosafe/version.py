"""The version, in the one place where it stands; package.xml has it too, as a test sees to."""

VERSION = "0.2.0"
