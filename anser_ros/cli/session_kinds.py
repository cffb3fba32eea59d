"""Finds what takes a session of other trackers, by the options of `commands.SESSION_KINDS`."""

import argparse
import importlib
from types import ModuleType

from anser_ros.cli.commands import SESSION_KINDS
from anser_ros.errors import ParameterError


def add_session_kinds(parser: argparse.ArgumentParser) -> None:
    """Declare an option for each kind of session, and the options that it has."""
    for name, (module, line) in SESSION_KINDS.items():
        parser.add_argument(f'--{name}', action='store_true', help=line)
        importlib.import_module(module).add_options(parser)


def named_kind(args: argparse.Namespace) -> ModuleType | None:
    """Return the module of the kind of session that the options name, None for one of fluxes."""
    for name, (module, _) in SESSION_KINDS.items():
        if getattr(args, name):
            return importlib.import_module(module)
    return None


def need_model(args: argparse.Namespace) -> None:
    """Raise `ParameterError` where a session of fluxes has no model."""
    if args.model is None:
        kinds = ', '.join(f'--{name}' for name in SESSION_KINDS)
        raise ParameterError(f'the following arguments are required: --model (or {kinds})')
