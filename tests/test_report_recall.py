"""RecallRate@N for every N, held to the figures of the metrics."""

import numpy as np
import pytest
from reports import noisy, report_of

from ssrvlad_torch.evaluation.metrics import evaluate
from ssrvlad_torch.evaluation.outcomes import judge
from ssrvlad_torch.evaluation.report.recall import recall_rates
from ssrvlad_torch.recognition.matching import match


@pytest.mark.parametrize("convention", ["exact", "vpr-bench"])
def test_rates_and_intervals_are_those_of_the_metrics(convention):
    queries, references = noisy(80, 90, 4.0)
    found = match(queries.descriptors, references.descriptors, top=30)
    scores, indices = (best.numpy() for best in found)
    truth = [np.array([row] if row % 5 else [], np.int64) for row in range(80)]
    n = range(1, 31)
    expected = evaluate(scores, indices, truth, at=n, convention=convention, resamples=70)
    rates = recall_rates(judge(scores, indices, truth), 30, convention, resamples=70)
    assert rates.n.tolist() == [*n]
    np.testing.assert_allclose(rates.rate, [expected["recall_at"][str(k)] for k in n], atol=1e-12)
    ends = np.array([expected["intervals"]["recall_at"][str(k)] for k in n])
    np.testing.assert_allclose(np.stack((rates.low, rates.high), 1), ends, atol=1e-12)
    assert 0 < rates.rate[0] < rates.rate[-1] < 1


@pytest.mark.parametrize("queries", [0, 2])
def test_nothing_to_be_found_has_no_rate(queries):
    report = report_of(*noisy(queries, 3), [[]] * queries)
    rates = recall_rates(report.outcomes, 5)
    assert np.isnan(rates.rate).all()
    assert np.isnan(rates.low).all()
