"""`python -m jaxchain` is the `jaxchain` command."""

from jaxchain.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
