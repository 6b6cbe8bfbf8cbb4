"""`python -m scopemap`: the same as `scopemap`."""

from scopemap.cli.app import main

if __name__ == "__main__":
    main()
