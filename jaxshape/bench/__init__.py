"""A benchmark of searches over latent codes that others can enter.

problem_set  measurements of the objects of a frozen set, packed, with its hash
problems     a problem: the objective of one object as a function of a code
watching     every evaluation of a search, counted on the side of the problem
ask_tell     searches of other packages, which run on the host: pycma, nevergrad
contest      a method on a batch of problems, until its budget is spent
entries      the file of one method's results: reading, merging, validation
run          methods on all problems, a batch at a time; a killed run can be resumed
standings    shares of targets reached, and the table of a board
board        the board as a picture and as a page
machine      the machine that results were made on
"""
