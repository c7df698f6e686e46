"""What a flight was like, from its recordings and the true motion of its vehicles.

flight     what is known of one flight
truth      the vehicles' true motion as arrays
steady     the part that errors are taken over, and the errors
believed   the same from the vehicles' own estimates
loops      gaps, traffic and CPU of the companions
criteria   what a flight must meet
summarise  all of it as summary.json holds it
"""
