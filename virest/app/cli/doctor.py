"""`virest doctor`: check the installation and what would slow it down."""

from __future__ import annotations

from virest.app import console
from virest.app.cli.options import Json, Quiet, Verbose, Version, emit_facts


def doctor(json: Json = False, quiet: Quiet = False, verbose: Verbose = False, version: Version = False) -> int:
    """Check the installation: versions, cores, memory, codecs, extras, and what would slow processing down.

    \b
    $ virest doctor
    ...
    all requirements are installed
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    from virest.app.doctor import examine

    facts, text, code = examine()
    emit_facts(facts, text, as_json=json, quiet=quiet)
    return code
