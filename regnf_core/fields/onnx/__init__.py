"""Evaluation of graphs of ONNX's operators with torch: one function an operator, nothing compiled, nothing loaded."""
