"""Version, date and authors. Tests check that manifests of packages, licence and CITATION.cff have the same."""

VERSION = "0.4.0"
RELEASED = "2026-11-26"  # the date of this version, or of the last one while changes are unreleased
AUTHORS = "rosAFE maintainers"  # also in package.xml, pyproject.toml, LICENSE, docs/conf.py and debian/
