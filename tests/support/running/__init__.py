"""Services, brokers and disks that tests run against."""
