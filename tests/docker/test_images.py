"""What tries the images: how it reads this machine's pip, plans its runs and judges a result; and the trial itself."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scripts.images.commands import documented_commands
from scripts.images.pip_settings import as_file, merged, named_paths
from scripts.images.trial import DATA, TrialError, check, plan_of
from tests.docker.files import ROOT


def test_pip_is_configured_as_on_this_machine(tmp_path: Path) -> None:
    (tmp_path / "wheels").mkdir()
    (tmp_path / "index" / "simple").mkdir(parents=True)
    listing = (
        ":env:.cert='/nowhere/cert.pem'\n"
        ":env:.find-links='/of/the/environment'\n"
        "global.cert='/of/a/file'\n"
        f"global.extra-index-url='file://{tmp_path}/index/simple\\nhttps://packages.example/simple'\n"
        f"global.trusted-host='{tmp_path}/wheels'\n"
        "install.user='false'\n"
    )
    options = merged(listing)
    assert options["cert"] == "/nowhere/cert.pem", "the environment goes before the files"
    assert as_file(options) == (
        "[global]\n"
        "cert = /nowhere/cert.pem\n"
        f"extra-index-url = file://{tmp_path}/index/simple https://packages.example/simple\n"
        "find-links = /of/the/environment\n"
        f"trusted-host = {tmp_path}/wheels\n"
    )
    assert named_paths(options) == {tmp_path / "wheels", tmp_path / "index"}


def test_every_command_is_run_or_said_not_to_be() -> None:
    plans = [(command, *plan_of(command)) for command in documented_commands(ROOT)]
    assert {tuple(left_out) for _, _, left_out in plans} == {
        ("proxy",), ("proxy", "worker-gpu"), ("proxy", "prometheus", "grafana"),
    }  # fmt: skip
    assert {plan.workers for _, plan, _ in plans if plan} == {1, 4}
    for command, plan, left_out in plans:
        assert (plan is None) == ("worker-gpu" in left_out), command.text
    assert len({plan.key for _, plan, _ in plans if plan}) == 3, "without tokens, with tokens, with four workers"


def test_the_truth_passes_and_a_wrong_result_does_not() -> None:
    T = np.array(json.loads((DATA / "truth.json").read_text(encoding="utf-8"))["T_object_scene"]["matrix"])
    larger, turned = T @ np.diag([1.05, 1.05, 1.05, 1.0]), T.copy()
    turned[:2, :3] = -T[1, :3], T[0, :3]

    def trial(matrix: Any, verdict: str = "registered") -> None:
        check({"verdict": verdict, "T_object_scene": {"matrix": matrix.tolist()}, "center_object": [0.0, 0.0, 0.0]})

    trial(T)
    for wrong in ((T + 0.5 * (np.arange(16) == 3).reshape(4, 4),), (larger,), (turned,), (T, "not_registered")):
        with pytest.raises(TrialError):
            trial(*wrong)


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("action", ["build", "try", "demo"])
def test_the_images_are_built_and_do_what_is_documented(action: str) -> None:
    if os.environ.get("REGNF_TEST_IMAGES") != "1":
        pytest.skip("takes some 20 minutes, root and buildah: set REGNF_TEST_IMAGES=1")
    done = subprocess.run([ROOT / "scripts/images.sh", action], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
