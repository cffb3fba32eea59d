"""Figures that the documents quote are those of the results kept in docs/results."""

import json
import re

import pytest
import yaml
from conftest import REPO

from anser_ros.apps.lab.experiments.report import write_report

RESULTS = REPO / 'docs' / 'results'
QUOTES = yaml.safe_load((RESULTS / 'quotes.yaml').read_text())
FIGURE = re.compile(r'\[\[(.*?) \| (.*?)\]\]')


def figure(path):
    name, *keys = path.split(' > ')
    found = json.loads((RESULTS / f'{name}.json').read_text())
    for key in keys:
        if isinstance(found, list):
            (found,) = (row for row in found if row['name'] == key)
        else:
            found = found[key]
    return found


def filled(line):
    return FIGURE.sub(lambda match: format(figure(match[1]), match[2]), line)


@pytest.mark.parametrize(('document', 'lines'), QUOTES.items(), ids=QUOTES)
def test_a_document_quotes_what_was_measured(document, lines):
    there = (REPO / document).read_text().splitlines()
    wrong = [line for line in map(filled, lines) if line not in there]
    assert not wrong, f'{document} has to say:\n' + '\n'.join(wrong)


def test_tables_of_results_have_no_row_that_is_not_compared():
    """Each table with a compared row is compared whole."""
    for document, lines in QUOTES.items():
        quoted = set(map(filled, lines))
        for table in re.findall(r'(?:^\|.*\n)+', (REPO / document).read_text(), re.MULTILINE):
            rows = table.splitlines()[2:]
            if not quoted.isdisjoint(rows):
                left = [row for row in rows if row not in quoted and '*' not in row]
                assert not left, document


def test_the_report_of_the_experiments_is_made_of_its_results(tmp_path):
    kept = REPO / 'docs' / 'paper' / 'paper.md'
    figures = dict(re.findall(r'!\[(.*?)\]\((.*?)\)', kept.read_text()))
    write_report(figure('paper'), figures, tmp_path / 'paper.md')
    assert (tmp_path / 'paper.md').read_text() == kept.read_text()
    assert all((kept.parent / name).is_file() for name in figures.values())
