"""What notebooks show of candidates."""

import torch

from ssrvlad_torch import match
from ssrvlad_torch.recognition.recognise import recognise, references_of


def test_candidates_are_a_table_of_at_most_ten_queries():
    frames = torch.eye(12)
    page = match(torch.cat((frames, frames * 0)), frames, top=2)._repr_html_()
    assert page.count("<tr>") == 11 and "row 3 (1.000)" in page and "14 more queries" in page
    assert "none" in match(frames[:1] * 0, frames, top=1)._repr_html_()
    town = references_of({"ssr-vlad": frames}, ["b"] * 12)
    page = recognise({"ssr-vlad": frames[:3]}, ["a"] * 3, town)._repr_html_()
    assert page.count("<th>") == 7 and "confidence" in page
