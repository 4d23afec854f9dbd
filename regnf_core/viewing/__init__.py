"""What a registration leaves to read and to look at: the result document, clouds, trace, residuals, a picture."""

from regnf_core.viewing.artifacts import write_artifacts
from regnf_core.viewing.document import ranking_document, result_document

__all__ = ["ranking_document", "result_document", "write_artifacts"]
