"""What a video system did to the pictures: two views in one, two fields in one, the same picture again."""
