"""The version of regnf: the one place that says it."""

from __future__ import annotations

__version__ = "0.3.0"


# The revision of the engine: a number that is raised when registrations give other results than before.
#
# The same fields, detection, options and seed give the same result as long as the revision stays the same. So it is a
# part of every job's id, and of the names of stored object models: no result of an older engine is ever returned as
# one of this engine. The version of the package does not say this. It changes with each release, and not in between.
#
# ``python -m scripts.engine_revision`` runs the golden registrations again, and raises the revision when their
# results have changed. A test fails when the engine's code has changed and this was not done.

ENGINE_REVISION = 26
