"""The files of a registration: result document, point clouds, history, residuals, picture."""

from regnf_core.viewing.document import ranking_document, result_document, write_artifacts

__all__ = ["ranking_document", "result_document", "write_artifacts"]
