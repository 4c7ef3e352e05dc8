"""The former name of `rosafe.declarations`, for plugins that were written for 0.2. Removed in the next release."""
