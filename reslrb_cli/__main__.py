"""Entry point of `python -m reslrb_cli`, which is the same as `reslrb`."""

from reslrb_cli.cli import run

if __name__ == "__main__":
    run()
