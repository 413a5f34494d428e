//! The flag that sets who may read the results of a command.

/// Who may read the results of a command that show where the robot was.
#[derive(Clone, Copy, Debug, clap::Args)]
pub(crate) struct PermissionArgs {
    /// Create files with the permissions of your umask, instead of only for you
    #[arg(long)]
    pub(crate) public_files: bool,
}
