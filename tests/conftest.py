"""What all tests share: where the real data lie, which tests need an extra, and which are quick."""

from __future__ import annotations

import os
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

# Tests that run side by side share the cores. OpenBLAS takes all of them for each process, and its threads spin while
# they wait: two modules took 37 s of processor time in place of 24. Set before numpy is loaded.
if workers := os.environ.get("PYTEST_XDIST_WORKER_COUNT"):
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    os.environ.setdefault("OMP_NUM_THREADS", str(max(cores // int(workers), 1)))
_DEFAULT = Path(__file__).resolve().parents[2] / "shared" / "data"
# Modules of tests that cannot be imported without a package, and the extra that brings it.
NEEDS = {
    **dict.fromkeys(
        (
            "test_benchmark_paper_plans",
            "test_benchmark_same_run",
            "test_depth_networks",
            "test_depth_scopenet",
            "test_flow",
            "test_instruments",
            "test_paper_strict",
            "test_perceptual",
            "test_training_loop",
            "test_training_losses",
        ),
        ("torch", "networks"),
    ),
    "test_training_instruments": ("onnx", "dev"),
    "test_examples": ("nbclient", "dev"),
}
# Others of which some tests skip without the networks.
PARTLY_NETWORKS = {"test_alike", "test_depth_benchmark", "test_weights"}
BROWSER = {"test_browser_result_chromium", "test_browser_start", "test_report_browser", "test_report_measuring"}
CLUSTER = {"test_engines", "test_addresses"}
# Runs of whole clips, or of many processes: a module takes more than three seconds on an idle core. In other modules
# single tests are marked `slow`, for the same reason.
SLOW = {
    "test_ends_of_settings",
    "test_backwards",
    "test_bad_input",
    "test_browser_result_page",
    "test_baselines_photometric",
    "test_batch",
    "test_benchmark_runner",
    "test_browser_choice",
    "test_browser_compare",
    "test_browser_live",
    "test_browser_serving",
    "test_browser_start",
    "test_burned_in_text",
    "test_camera_calibration",
    "test_cli",
    "test_cli_compare",
    "test_cli_demo",
    "test_cli_inspect",
    "test_cli_interruption",
    "test_cli_report",
    "test_colmap_method",
    "test_compare_exams",
    "test_depth_preview",
    "test_documented_commands",
    "test_documented_runs",
    "test_faulty_frames",
    "test_file_names",
    "test_films",
    "test_focal",
    "test_free_space",
    "test_full_disk",
    "test_fusion_sizes",
    "test_held_out",
    "test_in_python",
    "test_inspection",
    "test_lens_trial",
    "test_live",
    "test_live_coverage",
    "test_local_adjustment",
    "test_long_runs",
    "test_lost_and_found",
    "test_maps",
    "test_memory",
    "test_moving_tissue",
    "test_networks_extra",
    "test_other_starts",
    "test_overlays",
    "test_path_of_a_frame",
    "test_phantom_motion",
    "test_phantom_pictures",
    "test_phantom_polyps",
    "test_phantom_truth",
    "test_pipeline",
    "test_pipeline_anchor",
    "test_pipeline_backend",
    "test_pipeline_flow",
    "test_quiet",
    "test_reconstruction",
    "test_reconstructor",
    "test_resume",
    "test_scale_drift",
    "test_security",
    "test_skipped_frames",
    "test_skipping",
    "test_speed",
    "test_stereo_depth",
    "test_training_scenes",
    "test_verify",
}
GROUPS = {"networks": PARTLY_NETWORKS, "browser": BROWSER, "cluster": CLUSTER, "slow": SLOW}


class _Absent(pytest.Module):
    """A module whose tests are skipped, since a package is not installed."""

    def collect(self) -> Iterator[pytest.Item]:
        package, extra = NEEDS[self.path.stem]
        pytest.skip(f"needs {package}: pip install -c constraints.txt -e '.[{extra}]'", allow_module_level=True)


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> pytest.Module | None:
    """Skip a module of tests, with the reason, where it cannot be imported."""
    package, _ = NEEDS.get(module_path.stem, (None, None))
    if package is None or find_spec(package) is not None:
        return None
    absent: pytest.Module = _Absent.from_parent(parent, path=module_path)
    return absent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests by what they need; those that need nothing and take little are quick."""
    for item in items:
        module = item.path.stem
        needed = NEEDS.get(module, ("", ""))[1]
        if needed:
            item.add_marker(needed)
        for name, modules in GROUPS.items():
            if module in modules:
                item.add_marker(name)
        if not any(item.get_closest_marker(name) for name in ("dev", "real", *GROUPS)):
            item.add_marker("quick")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real frames and weights (docs/install.md, "Tests"); the test skips where it is absent."""
    folder = Path(os.environ.get("SCOPEMAP_REAL_DATA", _DEFAULT))
    if not folder.is_dir():
        pytest.skip(f"real data not found in {folder}; set SCOPEMAP_REAL_DATA to run this test")
    return folder
