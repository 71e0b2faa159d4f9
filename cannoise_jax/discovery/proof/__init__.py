"""What holds on frames that took no part: likelihood, two-sample test, gate, adequacy and the check after."""
