"""`python -m sim.study NAME` is `fleet study NAME`."""

from sim.study.cli import main

if __name__ == "__main__":
    main()
