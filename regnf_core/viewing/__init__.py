"""The files of a registration: result document, point clouds, history, residuals, picture."""

from regnf_core.viewing.artifacts import write_artifacts
from regnf_core.viewing.document import ranking_document, result_document

__all__ = ["ranking_document", "result_document", "write_artifacts"]
