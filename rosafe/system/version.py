"""Version and authors. Tests check that manifests of packages, licence and CITATION.cff have the same."""

VERSION = "0.4.0"
AUTHORS = "rosAFE maintainers"  # also in package.xml, pyproject.toml, LICENSE, docs/conf.py and debian/
