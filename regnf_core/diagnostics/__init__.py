"""What a registration leaves to read and to look at: the result document, clouds, trace, residuals, a picture."""

from regnf_core.diagnostics.artifacts import write_artifacts
from regnf_core.diagnostics.document import result_document

__all__ = ["result_document", "write_artifacts"]
