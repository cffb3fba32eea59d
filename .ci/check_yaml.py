"""Says which of the given files is no YAML, and where: .ci/check_yaml.py FILE [FILE ...]."""

import sys

import yaml


def check(paths):
    """Return how many of the files can't be read as YAML, after a line about each."""
    bad = 0
    for path in paths:
        try:
            with open(path, encoding='utf-8') as stream:
                list(yaml.safe_load_all(stream))
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            print(f'{path}: {" ".join(str(error).split())}')
            bad += 1
    return bad


if __name__ == '__main__':
    sys.exit(1 if check(sys.argv[1:]) else 0)
