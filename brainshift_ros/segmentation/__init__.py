"""From a T1 MR to labels and dural septa, by registration of the template; and what such a segmentation is worth."""
