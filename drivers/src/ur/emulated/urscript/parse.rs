//! Turns a program into instructions.

use super::expression::{Expression, ExpressionReader};
use super::token::{Token, tokens};

/// One step of a program. Targets of jumps are indices of instructions.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Instruction {
    Assign(String, Expression),
    /// Evaluates an expression for its effect.
    Evaluate(Expression),
    JumpUnless(Expression, usize),
    Jump(usize),
}

/// A program of one function.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Program {
    pub(crate) name: String,
    pub(super) instructions: Vec<Instruction>,
}

/// A block that is not closed yet.
enum Block {
    While {
        start: usize,
        exit: usize,
    },
    If {
        /// The jump to the next branch, if the condition does not hold.
        next: Option<usize>,
        /// The jumps from the ends of the branches to the end of the block.
        exits: Vec<usize>,
    },
}

/// Parses a program.
///
/// # Errors
/// If the text is not of the supported part of URScript. The error names the line.
pub(crate) fn parse(text: &str) -> Result<Program, String> {
    let mut parser = Parser::default();
    for (ix, line) in text.lines().enumerate() {
        parser
            .line(line)
            .map_err(|reason| format!("line {}: {reason}", ix + 1))?;
    }
    match (parser.name, parser.is_complete) {
        (Some(name), true) => Ok(Program {
            name,
            instructions: parser.instructions,
        }),
        _ => Err("the program is incomplete".to_owned()),
    }
}

#[derive(Default)]
struct Parser {
    name: Option<String>,
    instructions: Vec<Instruction>,
    blocks: Vec<Block>,
    is_complete: bool,
}

impl Parser {
    fn line(&mut self, line: &str) -> Result<(), String> {
        let tokens = tokens(line)?;
        let Some(first) = tokens.first() else {
            return Ok(());
        };
        if self.name.is_none() {
            return self.definition(&tokens);
        }
        if self.is_complete {
            return Err("text follows the end of the program".to_owned());
        }
        let keyword = match first {
            Token::Name(name) => name.as_str(),
            _ => return Err("a statement is missing".to_owned()),
        };
        match keyword {
            "while" => {
                let start = self.instructions.len();
                let exit = self.push_branch(&tokens[1..])?;
                self.blocks.push(Block::While { start, exit });
            }
            "if" => {
                let next = Some(self.push_branch(&tokens[1..])?);
                let exits = Vec::new();
                self.blocks.push(Block::If { next, exits });
            }
            "elif" => {
                let mut exits = self.end_branch()?;
                exits.push(self.instructions.len() - 1);
                let next = Some(self.push_branch(&tokens[1..])?);
                self.blocks.push(Block::If { next, exits });
            }
            "else" => {
                let mut exits = self.end_branch()?;
                exits.push(self.instructions.len() - 1);
                self.blocks.push(Block::If { next: None, exits });
            }
            "end" => self.end()?,
            _ => self.statement(&tokens)?,
        }
        Ok(())
    }

    fn definition(&mut self, tokens: &[Token]) -> Result<(), String> {
        match tokens {
            [
                Token::Name(def),
                Token::Name(name),
                Token::Symbol("("),
                Token::Symbol(")"),
                Token::Symbol(":"),
            ] if def == "def" => {
                self.name = Some(name.clone());
                Ok(())
            }
            _ => Err("a program starts with `def NAME():`".to_owned()),
        }
    }

    fn statement(&mut self, tokens: &[Token]) -> Result<(), String> {
        self.instructions.push(match tokens {
            [Token::Name(name), Token::Symbol("="), rest @ ..] => {
                Instruction::Assign(name.clone(), ExpressionReader::new(rest).only()?)
            }
            _ => Instruction::Evaluate(ExpressionReader::new(tokens).only()?),
        });
        Ok(())
    }

    /// Adds the jump for a condition, and returns its index. The target is set later.
    fn push_branch(&mut self, tokens: &[Token]) -> Result<usize, String> {
        let [condition @ .., Token::Symbol(":")] = tokens else {
            return Err("the colon at the end is missing".to_owned());
        };
        let condition = ExpressionReader::new(condition).only()?;
        self.instructions
            .push(Instruction::JumpUnless(condition, usize::MAX));
        Ok(self.instructions.len() - 1)
    }

    /// Ends a branch of an `if` with a jump to its end. Returns the earlier jumps to the end.
    fn end_branch(&mut self) -> Result<Vec<usize>, String> {
        let Some(Block::If {
            next: Some(next),
            exits,
        }) = self.blocks.pop()
        else {
            return Err("a branch without `if`".to_owned());
        };
        self.instructions.push(Instruction::Jump(usize::MAX));
        self.set_target(next);
        Ok(exits)
    }

    fn end(&mut self) -> Result<(), String> {
        match self.blocks.pop() {
            None => self.is_complete = true,
            Some(Block::While { start, exit }) => {
                self.instructions.push(Instruction::Jump(start));
                self.set_target(exit);
            }
            Some(Block::If { next, exits }) => {
                for jump in next.into_iter().chain(exits) {
                    self.set_target(jump);
                }
            }
        }
        Ok(())
    }

    /// Sets the target of a jump to the next instruction.
    fn set_target(&mut self, jump: usize) {
        let next = self.instructions.len();
        if let Instruction::JumpUnless(_, target) | Instruction::Jump(target) =
            &mut self.instructions[jump]
        {
            *target = next;
        }
    }
}
