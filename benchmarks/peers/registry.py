"""All methods by name, and which optional package each needs."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.peers.gicp import SmallGicp
from benchmarks.peers.interface import MissingPackageError, Peer
from benchmarks.peers.kiss import KissMatcher
from benchmarks.peers.nerf2nerf import Nerf2nerf
from benchmarks.peers.open3d_peers import FastGlobalRegistration, RansacIcp
from benchmarks.peers.presets import RegnfPreset
from benchmarks.peers.splats import Splatreg


@dataclass(frozen=True)
class Entry:
    """How a method is made. module, package: what it needs beyond regnf's own dependencies, as imported and on PyPI."""

    factory: Callable[[], Peer]
    module: str | None = None
    package: str | None = None

    def make(self) -> Peer:
        """The method. Raises MissingPackageError."""
        if self.module is not None and importlib.util.find_spec(self.module) is None:
            raise MissingPackageError(self.package or self.module)
        return self.factory()


PEERS: dict[str, Entry] = {
    "robust": Entry(lambda: RegnfPreset("robust")),
    "paper": Entry(lambda: RegnfPreset("paper")),
    "nerf2nerf": Entry(Nerf2nerf),
    "fgr": Entry(lambda: FastGlobalRegistration(normalized=False)),
    "fgr_normalized": Entry(lambda: FastGlobalRegistration(normalized=True)),
    "ransac_icp": Entry(lambda: RansacIcp(normalized=False, scaled=False)),
    "ransac_icp_normalized": Entry(lambda: RansacIcp(normalized=True, scaled=False)),
    "ransac_icp_scaled": Entry(lambda: RansacIcp(normalized=True, scaled=True)),
    "kiss_matcher": Entry(lambda: KissMatcher(normalized=False), "kiss_matcher", "kiss-matcher"),
    "kiss_matcher_normalized": Entry(lambda: KissMatcher(normalized=True), "kiss_matcher", "kiss-matcher"),
    "splatreg": Entry(lambda: Splatreg("robust"), "splatreg", "splatreg"),
    "splatreg_normalized": Entry(lambda: Splatreg("robust", normalized=True), "splatreg", "splatreg"),
    "small_gicp": Entry(SmallGicp, "small_gicp", "small_gicp"),
}
