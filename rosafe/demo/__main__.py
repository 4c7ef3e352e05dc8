"""Entry point of `python3 -m rosafe.demo`, which scripts/demo runs."""

import sys

from rosafe.demo.command import main

sys.exit(main())
