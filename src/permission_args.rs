//! The flag that sets who may read the results of a command.

/// Who may read the results of a command. The results show where the robot was.
#[derive(Clone, Copy, Debug, clap::Args)]
pub(crate) struct PermissionArgs {
    /// Create files with the permissions of your umask [default: only you can read them]
    #[arg(long)]
    pub(crate) public_files: bool,
}
