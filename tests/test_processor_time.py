"""The limit of the processor time of a test, and the list of all."""

import pytest


def run(pytester: pytest.Pytester, *options: str) -> pytest.RunResult:
    pytester.makepyfile(
        """
        import pytest

        def test_unmarked():
            sum(range(200_000))

        @pytest.mark.slow
        def test_slow():
            sum(range(200_000))
        """
    )
    pytester.makeini("[pytest]\nmarkers = slow")
    plugins = ["-p", "no:tactile-cell", "-p", "no:cacheprovider", "-p", "tests.processor_time"]
    return pytester.runpytest_inprocess(*plugins, *options)


def test_an_unmarked_test_above_the_limit_fails_and_a_marked_one_passes(pytester) -> None:
    with pytest.MonkeyPatch.context() as patch:  # it is the limit of this test, too
        patch.setattr("tests.processor_time.TEST_LIMIT_S", 1e-5)
        result = run(pytester)
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["*simulate less, or mark it `slow`*", "FAILED *::test_unmarked*"])
