"""Where a camera should look next: candidates, what each would see, and what that would tell."""
