"""The plan: the formation's reference motion p_ref, v_d, a_d, as a function of fleet time alone."""
