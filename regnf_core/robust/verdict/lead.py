"""By how much a pose is better than the next one that is another answer.

Poses are compared by their merits: the log odds say which of them fit at all, the score says which of these fits best.
A pose that is right stands out among all that a search found. Where an object is not in the box, or the right pose was
lost, several poses are about as likely.

An answer may list several poses that fit alike, of which one is right. They are no rivals of the answer as a whole.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.constants import MODEL, VERDICT
from regnf_core.robust.model.self_symmetry import SelfSymmetry
from regnf_core.robust.search.rotations import turns_about


def merits(log_odds: Tensor, scores: Tensor) -> Tensor:
    """(H,) in log odds, larger is better: what poses with these log odds (H,) of being right, each alone, and scores
    (H,), 0..1, smaller is better, are compared by."""
    return log_odds - VERDICT.log_odds_per_score * scores.to(log_odds)


def leads(merits: Tensor, apart: Tensor) -> Tensor:
    """(H,): each pose's merit (H,) above that of the best of the poses that are ``apart`` (H, H) from it, at most
    VERDICT.most_lead, which is also the lead of a pose without any."""
    others = torch.where(apart, merits, -torch.inf).amax(1)
    return (merits - others).clamp(-VERDICT.most_lead, VERDICT.most_lead)


def apart_from_answer(apart: Tensor, answer: Sequence[int]) -> Tensor:
    """(H, H) as ``apart``, but a pose of the ``answer``, given by their numbers, is apart only from poses that are
    apart from all of them."""
    joined = apart.clone()
    joined[list(answer)] = apart[list(answer)].all(0)
    return joined


def apart(T: Sim3, points: Tensor, symmetry: SelfSymmetry) -> Tensor:
    """(H, H) bool: which of the poses T (H,) place the object elsewhere than which, its symmetries allowed for.

    points: (E, 3), the object's outermost ones. Two poses are apart if they place one of them more than VERDICT.apart
    diameters apart. The diagonal is False.
    """
    points = points.double()
    placed = T.inverse().apply(points)
    alike = _alike(symmetry).inverse().apply(points)
    rows = []
    for number in range(len(T)):
        pose = T[number]
        equivalents = pose.inverse().apply(alike.reshape(-1, 3)).reshape(alike.shape)
        far = (placed[:, None] - equivalents).norm(dim=-1).amax(-1).amin(-1)
        rows.append(pose.scale * far > VERDICT.apart)
    return torch.stack(rows)


def _alike(symmetry: SelfSymmetry) -> Sim3:
    """(K,) the object's symmetries, the identity among them, with turns about its axis in small steps."""
    identity = Sim3.identity()[None]
    exact = Sim3.cat([identity, symmetry.T[symmetry.deviation <= MODEL.max_deviating_share]])
    if symmetry.axis is None:
        return exact
    rotations = turns_about(symmetry.axis, VERDICT.axis_turns)
    turns = Sim3(torch.ones(len(rotations)).double(), rotations, torch.zeros(len(rotations), 3).double())
    return Sim3.cat([turn[None] @ exact for turn in turns])
