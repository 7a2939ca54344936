"""From a law to a controller file: ONNX graph, parity gate, manifest. Nothing that runs the file stands here."""
