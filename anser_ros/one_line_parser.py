"""Parses every command line of the package: what is wrong is one clear line."""

import argparse
from typing import NoReturn


class OneLineParser(argparse.ArgumentParser):
    """Ends with exit code 2 and one line on stderr, without the usage of a page or more."""

    def error(self, message: str) -> NoReturn:
        """State what is wrong and where the usage is, and exit."""
        self.exit(2, f'{self.prog}: {" ".join(message.split())} (usage: {self.prog} --help)\n')
