"""Operations on Gaussians that the offline job and the service have in common."""
