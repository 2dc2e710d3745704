"""A plugin of pytest: where CI is true, a test that is skipped fails, unless it may be."""

import os

import pytest

ALLOWED_SKIPS = ("CUDA", "../shared", "wine64")
"""What the reason of a skip must mention where CI is true: what a machine of CI cannot have."""


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport():
    """Where CI is true, a test that is skipped fails, unless it may be."""
    outcome = yield
    _refuse_skip(outcome.get_result())


@pytest.hookimpl(hookwrapper=True)
def pytest_make_collect_report():
    """The same for the tests of a whole file."""
    outcome = yield
    _refuse_skip(outcome.get_result())


def _refuse_skip(report):
    if os.environ.get("CI") != "true" or not report.skipped or hasattr(report, "wasxfail"):
        return
    *_, reason = report.longrepr
    if not any(allowed in reason for allowed in ALLOWED_SKIPS):
        report.outcome, report.longrepr = "failed", f"skipped, which CI does not allow: {reason}"
