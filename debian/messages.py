"""Generate the messages of the Debian package: Python modules and ROS package folders below the given folder."""

from __future__ import annotations

import sys
from pathlib import Path

from rosafe.ros1.component import generate


def main(folder: Path) -> None:
    """Create ``python`` and ``share`` in `folder`, independent of its name and of the packages of this machine."""
    found = generate.sources()
    assert found is not None, "run this in a checkout"
    generated = folder / "messages"
    generate.build(found, generated)
    (generated / "python").rename(folder / "python")
    for package in found.packages:
        share = generated / "share" / package
        for link in [path for path in share.iterdir() if path.is_symlink()]:  # they point into this checkout
            link.unlink()
        (folder / "share").mkdir(exist_ok=True)
        share.rename(folder / "share" / package)
    for package in ("std_msgs", "actionlib_msgs", "diagnostic_msgs"):  # dependencies of the package rosafe
        generate.build_manifest(package, folder / generate.MANIFESTS / package)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
