"""From a control law to a controller file: the ONNX graph, the parity gate, the manifest inside."""
