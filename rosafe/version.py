"""The version. A test checks that package.xml has the same."""

VERSION = "0.3.0"
