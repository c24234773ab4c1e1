"""Is the loop stable under outages?"""
