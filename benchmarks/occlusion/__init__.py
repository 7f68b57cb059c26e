"""What does a filter believe of a ball behind a pillar?"""
