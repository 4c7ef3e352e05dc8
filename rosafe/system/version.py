"""Version and authors. Tests check that the manifests of all packages, the licence and CITATION.cff have the same."""

VERSION = "0.3.0"
AUTHORS = "rosAFE maintainers"  # also in package.xml, pyproject.toml, LICENSE, docs/conf.py and debian/
