"""`python -m reslrb_cli` does what `reslrb` does."""

from reslrb_cli.cli import run

if __name__ == "__main__":
    run()
