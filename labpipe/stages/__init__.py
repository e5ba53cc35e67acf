"""The stages that turn one thing into the next: ingest, frf, identify, report; and calibrate."""
