"""The mutations of `scripts/test --mutations` fit the sources."""

from __future__ import annotations

import shlex

from tests.harness import ROOT
from tests.mutations import MUTATIONS


def test_each_old_text_occurs_once_and_the_tests_exist() -> None:
    for mutation in MUTATIONS:
        count = (ROOT / mutation.path).read_text("utf-8").count(mutation.old)
        assert count == 1, f"{mutation.name}: expected its old text once in {mutation.path}, got it {count} times"
        assert mutation.new != mutation.old, mutation.name
        paths = [word for word in shlex.split(mutation.tests) if word.startswith("tests")]
        assert paths and all((ROOT / path).exists() for path in paths), f"{mutation.name}: {mutation.tests}"


def test_there_are_mutations_of_every_package() -> None:
    assert len({mutation.name for mutation in MUTATIONS}) == len(MUTATIONS) >= 60
    folders = {path.parent.relative_to(ROOT).parts[:3] for path in (ROOT / "rosafe").glob("*/**/*.py")}
    with_code = {"/".join(folder) for folder in folders if len([*ROOT.joinpath(*folder).glob("*.py")]) > 1}
    missing = {folder for folder in with_code if not any(m.path.startswith(f"{folder}/") for m in MUTATIONS)}
    assert not missing, f"no mutation of {sorted(missing)}"
