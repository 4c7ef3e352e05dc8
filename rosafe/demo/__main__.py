"""`python3 -m rosafe.demo`, what scripts/demo runs."""

import sys

from rosafe.demo.command import main

sys.exit(main())
