"""`python -m torchdlo`, the same as `torchdlo`."""

from torchdlo.cli.app import main

if __name__ == "__main__":
    main()
