"""Opens the networks that the package brings, ONNX graphs, in ONNX Runtime on the CPU."""

from __future__ import annotations

import onnxruntime

from scopemap.io.device import cpu_threads


def open_network(content: bytes, threads: int = 0) -> onnxruntime.InferenceSession:
    """Return the session of an ONNX graph; raises what the runtime raises. threads : 0: one for each core."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or cpu_threads()
    # Threads that wait must sleep: the tracker needs the cores.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 4  # what is wrong is raised, not printed
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
