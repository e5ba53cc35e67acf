"""Theory of rotors: Timoshenko shafts with discs on bearings, their frequency response, unbalance response and stability."""
