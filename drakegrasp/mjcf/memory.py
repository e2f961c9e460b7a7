"""How much memory a simulation in MuJoCo has for the contacts of a step."""

#: Bytes; only those that are needed are touched. By default MuJoCo takes some 14 MB, and leaves
#: contacts out where that is too little, as with a hand deep in an object of many convex parts.
MEMORY = 256_000_000
