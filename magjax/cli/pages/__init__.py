"""Pages of docs/ that are written from the code: parameters, commands, results. `python -m magjax.cli.pages [--check]` does all."""
