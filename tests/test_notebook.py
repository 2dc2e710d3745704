"""docs/tutorial.ipynb: it runs, and gives what is kept in it."""

import nbformat
import tutorial


def given(notebook):
    """What the cells print, their tables, and which of them give pictures."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    texts = [output.text for output in outputs if output.output_type == "stream"]
    tables = [output.data.get("text/html", "") for output in outputs if "data" in output]
    pictures = [any("png" in str(form) for form in output.get("data", {})) for output in outputs]
    return texts, [text for text in tables if "<table>" in text], pictures


def test_the_notebook_gives_the_outputs_that_it_keeps():
    kept = nbformat.read(tutorial.NOTEBOOK, as_version=4)
    texts, tables, pictures = given(kept)
    assert (len(texts), len(tables), sum(pictures)) == (5, 2, 3)
    assert given(tutorial.executed()) == (texts, tables, pictures)
