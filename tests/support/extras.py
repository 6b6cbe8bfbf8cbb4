"""What is said where tests skip because an extra is not installed."""

NETWORKS = "needs torch: pip install -c constraints.txt -e '.[networks]'"
DEV = "needs nbclient and onnx: pip install -c constraints.txt -e '.[dev]'"
