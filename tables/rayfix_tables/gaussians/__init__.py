"""Operations on Gaussians for the offline job and the service."""
