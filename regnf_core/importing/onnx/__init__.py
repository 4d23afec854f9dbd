"""A strict reader of ONNX models: the graph and its weights, from the bytes given, without any library of ONNX's."""
