"""The texts of a recording: the verdict as Markdown, and what is said of a pose that was judged."""

from __future__ import annotations

from regnf_core.hints import verdict_hint
from regnf_core.result import ConsideredPose, RegistrationResult
from regnf_core.verdicts import verdict_in_words


def label_of(one: ConsideredPose) -> str:
    """Probability and reason, short."""
    return f"{_percent(one.metrics.get('probability'))}, {one.reason}"


def verdict_text(result: RegistrationResult, object_name: str | None = None) -> str:
    """Verdict, reason, probability, hint, the transform and the poses that were judged, as Markdown."""
    reason = result.verdict_reason
    lines = [f"# {result.verdict}", "", f"**{reason}**: {verdict_in_words(reason, result.verdict_limit)}", ""]
    if hint := verdict_hint(reason, result.options):
        lines += [hint, ""]
    if object_name is not None:
        lines += [f"Object: `{object_name}`", ""]
    if result.probability is not None:
        lines += [f"Probability that the answer is right: {_percent(result.probability)}", ""]
    lines += ["T_scene_object, the object's pose in the scene (object coordinates to scene coordinates):", "", "```"]
    lines += [" ".join(f"{value: .6f}" for value in row) for row in result.T_scene_object.matrix().tolist()]
    lines += ["```", ""]
    if result.considered is not None:
        lines += ["Poses that were judged (`scene/considered`):", "", "| | probability | reason | |"]
        lines += ["|---|---|---|---|"]
        lines += [
            f"| {number} | {_percent(one.metrics.get('probability'))} | {one.reason} | "
            f"{verdict_in_words(one.reason, one.limit)} |"
            for number, one in enumerate(result.considered.poses)
        ]
    return "\n".join(lines)


def _percent(probability: float | None) -> str:
    return "no probability" if probability is None else f"{100 * probability:.1f} %"
