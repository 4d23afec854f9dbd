"""The GPU: whether torch can use one that is there."""

from __future__ import annotations

import shutil
import subprocess
import sys
from importlib.util import find_spec

from regnf_cli.checks.finding import Finding

_ASK = (
    "import torch; print(torch.cuda.get_device_name(0) if torch.cuda.is_available() else '', torch.version.cuda or '')"
)
_S = 120


def check_gpu() -> Finding:
    """regnf needs none; a GPU that lies idle is a warning."""
    if find_spec("torch") is None:
        return Finding("gpu", "ok", "not looked for: torch is not installed")
    done = subprocess.run([sys.executable, "-c", _ASK], capture_output=True, text=True, timeout=_S, check=False)
    name, _, cuda = done.stdout.strip().rpartition(" ") if done.returncode == 0 else ("", "", "")
    if name:
        return Finding("gpu", "ok", f"{name}, CUDA {cuda}")
    if shutil.which("nvidia-smi") is None:
        return Finding("gpu", "ok", "none; everything runs on the processor")
    hint = "Install a torch that is built for your CUDA: pytorch.org has the command. regnf works without it, slower."
    return Finding("gpu", "warning", "there is an NVIDIA driver, but torch cannot use the GPU", hint)
