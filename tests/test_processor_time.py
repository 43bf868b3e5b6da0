"""The limit of the processor time of a test, and the list of all."""

import pytest

TESTS = """
import pytest

def test_unmarked():
    sum(range(200_000))

@pytest.mark.slow
def test_slow():
    sum(range(200_000))
"""


def test_an_unmarked_test_above_the_limit_fails_and_a_marked_one_passes(pytester) -> None:
    pytester.makepyfile(TESTS)
    pytester.makeini("[pytest]\nmarkers = slow")
    plugins = ["-p", "no:tactile-cell", "-p", "no:cacheprovider", "-p", "tests.processor_time"]
    with pytest.MonkeyPatch.context() as patch:  # it is the limit of this test, too
        patch.setattr("tests.processor_time.TEST_LIMIT_S", 1e-5)
        result = pytester.runpytest_inprocess(*plugins)
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["*simulate less, or mark it `slow`*", "FAILED *::test_unmarked*"])
