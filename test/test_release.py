"""What goes out: sdist and wheel install and run, and the other descriptions keep in step."""

import json
import re
import shutil
import subprocess
import sys
import zipfile
from xml.etree import ElementTree

import pytest
import yaml
from conftest import REPO

from anser_ros.cli.commands import COMPOSED, NODES, OFFLINE
from anser_ros.cli.main import PYPI

PACKAGE = ElementTree.parse(REPO / 'package.xml')
LEFT_OUT = shutil.ignore_patterns('.*', 'build', 'install', 'log', 'out', '*.egg-info', 'test')
BUILD = """
import sys
from setuptools import build_meta
print(getattr(build_meta, sys.argv[1])(sys.argv[2]))
"""


def run(command, cwd, **options):
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.processes
@pytest.mark.long
def test_a_wheel_of_the_sdist_runs(tmp_path):
    """As who installs a release: what the sdist lacks, the wheel that is made of it lacks too."""
    source = tmp_path / 'source'
    shutil.copytree(REPO, source, ignore=LEFT_OUT)
    out = tmp_path / 'dist'
    out.mkdir()
    name = run([sys.executable, '-c', BUILD, 'build_sdist', str(out)], source).split()[-1]
    shutil.unpack_archive(out / name, tmp_path / 'unpacked', filter='data')
    (unpacked,) = (tmp_path / 'unpacked').iterdir()
    name = run([sys.executable, '-c', BUILD, 'build_wheel', str(out)], unpacked).split()[-1]
    target = tmp_path / 'target'
    with zipfile.ZipFile(out / name) as wheel:
        wheel.extractall(target)
        listed = wheel.namelist()
    share = f'{name.split("-py3")[0]}.data/data/share/anser_ros'
    for folder in ('config', 'launch', 'bags'):
        files = {path.name for path in (REPO / folder).iterdir() if path.is_file()}
        assert {f'{share}/{folder}/{file}' for file in files} <= set(listed)
    page = {
        f'anser_ros/apps/dashboard/{path.name}'
        for path in (REPO / 'anser_ros/apps/dashboard').glob('*.[jc]s*')
    }
    assert page and page <= set(listed)
    (entry,) = (path for path in listed if path.endswith('entry_points.txt'))
    scripts = re.findall(r'^(\w+) = ', (target / entry).read_text(), re.MULTILINE)
    assert set(scripts) == {'anser', *NODES, *COMPOSED, *OFFLINE}
    code = 'import sys; sys.path.insert(0, sys.argv[1]); from anser_ros.cli.main import main; '
    code += 'import anser_ros; assert anser_ros.__file__.startswith(sys.argv[1]); '
    code += 'sys.exit(main(["--version"]))'
    said = run([sys.executable, '-P', '-c', code, str(target)], tmp_path)
    assert said == f'anser_ros {PACKAGE.findtext("version")}\n'


def test_the_image_has_the_packages_of_package_xml():
    """Ubuntu's names of what rosdep knows, and of PyPI what it does not."""
    text = (REPO / 'Dockerfile').read_text()
    needed = {element.text for element in PACKAGE.iter('exec_depend')}
    apt = {n if n.startswith('python3-') else f'ros-jazzy-{n.replace("_", "-")}' for n in needed}
    listed = set(re.findall(r'^    ((?:python3|ros-jazzy)-[a-z0-9-]+) \\$', text, re.MULTILINE))
    assert listed == apt | {'python3-pip'}
    (pip,) = re.findall(r'pip install[^\n]*\\\n +([^\n]+)', text)
    assert set(PYPI.values()) <= set(pip.split())
    assert 'noble' in text and 'jazzy' in text


def test_the_container_of_editors_is_that_image():
    document = json.loads((REPO / '.devcontainer' / 'devcontainer.json').read_text())
    folder = REPO / '.devcontainer'
    assert (folder / document['build']['dockerfile']).resolve() == REPO / 'Dockerfile'
    assert (folder / document['build']['context']).resolve() == REPO


def test_the_citation_has_version_and_licence():
    cited = yaml.safe_load((REPO / 'CITATION.cff').read_text())
    assert str(cited['version']) == PACKAGE.findtext('version')
    assert cited['license'] == PACKAGE.findtext('license')
    assert cited['cff-version'] == '1.2.0' and cited['authors'] and cited['title']
