"""What benchmarks/trust.py runs: systems, sick runs, healthy runs."""
